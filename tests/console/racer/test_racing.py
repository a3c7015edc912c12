"""A racer with a custom reward function, from the wizard's editor to the table of a league, by clicking."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.conftest import Serving
from tests.support.console.person import People, Person
from tests.support.console.training import ended, job_of

WRONG = 'def reward_function(params):\n    speed = params["speed"]\n    return params["sped"]\n'
RIGHT = 'def reward_function(params):\n    """Fast."""\n    return 0.5 + params["speed"]\n'


def test_an_edited_reward_function_is_checked_trained_and_raced_in_a_league(server: Serving, people: People) -> None:
    person = people(server.url)
    corrects_the_reward_function(person)
    job = ended(person)
    page = person.page
    expect(page.locator("#checkpoints tr[data-key]").first).to_be_visible()
    person.leave("Export")
    ended(person)
    page.goto(f"/jobs/{job}")
    page.get_by_label("Name of a clone, or of a model").fill("speedy")
    person.click("Register as a model")
    expect(page.locator("[data-message]")).to_contain_text("as speedy@1")
    creates_a_league(person)
    races(person)


def corrects_the_reward_function(person: Person) -> None:
    page = person.goto("/submit/task/Racer")
    train = {"train.worlds": "8", "train.iterations": "2", "train.seed": "1"}
    for name, value in {"name": "speedy", "resources.memory": "2GiB", **train}.items():
        page.locator(f'[name="{name}"]').fill(value)
    editor = page.locator('textarea[name="train.config.reward_function"]')
    editor.fill(WRONG)
    editor.blur()
    expect(page.locator(".numbers .bad").first).to_have_text("3")
    expect(page.locator('[data-wrong="train.config.reward_function"]')).to_contain_text("sped")
    person.picture("reward-function")
    editor.fill(RIGHT)
    editor.blur()
    expect(page.locator('[data-wrong="train.config.reward_function"]')).to_be_hidden()
    expect(page.locator("[data-yaml]")).to_contain_text("0.5 + params")
    person.click("Review")
    expect(page.get_by_role("heading", name="Plan")).to_be_visible()
    person.leave("Submit")
    job_of(person)


def creates_a_league(person: Person) -> None:
    page = person.goto("/leagues")
    page.get_by_label("Name").fill("evening")
    page.get_by_label("Laps", exact=True).fill("1")
    page.get_by_label("Longest lap, simulated").fill("60")
    page.get_by_label("A car that leaves the road").select_option("is put back and continues")
    person.click("Create")
    expect(page.get_by_role("heading", name="League evening")).to_be_visible()


def races(person: Person) -> None:
    page = person.page
    page.get_by_label("Model").fill("speedy")
    page.get_by_label("Racer").fill("ada")
    person.click("Race")
    race = page.get_by_role("region", name="Races").get_by_role("row").nth(1)
    expect(race.locator(".badge")).to_have_text("SUCCEEDED")
    race.get_by_label("as", exact=True).fill("ada")
    person.leave("Enter")
    expect(page.get_by_role("main")).to_contain_text("The entry and its model are as they were entered.")
    page.goto("/leagues/evening")
    expect(page.get_by_role("region", name="Table")).to_contain_text(re.compile("ada.*speedy@1", re.DOTALL))
    expect(page.get_by_role("region", name="Races").locator("tr[data-key]")).to_have_count(0)
    person.picture("league")
