"""From a wizard to a registered model, by clicking."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import expect

from tests.conftest import Serving
from tests.support.console.person import People, Person
from tests.support.console.training import ended, job_of, state_of, submit

TRAIN = {"train.worlds": "4", "train.iterations": "100000", "train.seed": "1"}
SMALL = {"name": "pole", "resources.memory": "1GiB", **TRAIN}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """A server without keys: its own user needs no login."""
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "4") as server:
        yield server


def newest(person: Person) -> int:
    """The iteration of the newest checkpoint in the table, which is marked here."""
    row = person.page.locator("#checkpoints tr[data-key]").first
    row.get_by_role("radio").check()
    return int(row.locator("td").nth(1).inner_text())


def test_a_training_goes_from_the_wizard_to_a_registered_model_by_clicking(server: Serving, people: People) -> None:
    person = people(server.url)
    page = person.page
    job = submit(person, "Cartpole", SMALL)
    watches_the_curve_grow(person)
    person.picture("job")
    saves_and_stops(person)
    resumed = resumes(person)
    server.client.batch("TerminateJob", jobId=resumed, reason="seen")
    expect(state_of(person)).to_have_text("FAILED")
    iteration = newest(person)
    person.leave("Evaluate")
    ended(person)
    page.goto(f"/jobs/{job}")
    expect(page.locator("#checkpoints tr[data-key]").first.locator("td").nth(3)).not_to_be_empty()
    newest(person)
    person.leave("Export")
    ended(person)
    page.goto(f"/jobs/{job}")
    assert newest(person) == iteration
    page.get_by_label("Name of a clone, or of a model").fill("balancer")
    person.click("Register as a model")
    expect(page.locator("[data-message]")).to_contain_text(f"@{iteration} as balancer@1")
    compares(person)
    page.goto("/models")
    person.click("balancer")
    expect(page.get_by_role("heading", name="Model balancer@1")).to_be_visible()
    person.click("Verify")
    expect(page.locator("main")).to_contain_text("Every file is as it was registered.")
    person.picture("model")
    page.goto("/")
    expect(page.locator("tr[data-key]")).to_have_count(4)
    person.picture("jobs")


def watches_the_curve_grow(person: Person) -> None:
    expect(state_of(person)).to_have_text("RUNNING")
    figure = person.page.locator("[data-charts] figure").first
    expect(figure).to_be_visible()
    progress = person.page.locator(".headline progress")
    seen = float(progress.get_attribute("value") or 0)
    person.page.wait_for_function("seen => document.querySelector('.headline progress').value > seen + 3", arg=seen)


def saves_and_stops(person: Person) -> None:
    person.click("Save a checkpoint now")
    expect(person.page.locator("#checkpoints tr[data-key]").first).to_be_visible()
    person.click("Stop")
    person.confirm()
    expect(state_of(person)).to_have_text("FAILED")
    expect(person.page.locator(".headline .why")).to_contain_text("stopped in the console by")
    expect(person.page.get_by_role("log").locator(".line").last).to_contain_text("node 0 ended")
    expect(person.page.locator("#attempts .span").first).to_have_attribute("data-state", "stopped")


def resumes(person: Person) -> str:
    """Go on from where it was stopped; returns the id of the new job."""
    iteration = newest(person)
    person.leave("Resume")
    job = job_of(person)
    expect(state_of(person)).to_have_text("RUNNING")
    expect(person.page.get_by_role("log")).to_contain_text(re.compile(rf"(from|resum).*{iteration}"))
    return job


def compares(person: Person) -> None:
    """The curve of the run, from the list of runs."""
    page = person.goto("/runs")
    page.get_by_role("region", name="Runs").locator("tr[data-key^=pole] input").check()
    person.leave("Compare marked")
    expect(page.get_by_role("region", name="Runs").locator("tbody tr")).to_have_count(1)
    expect(page.locator(".one-chart svg path").first).to_be_visible()
    person.picture("compare")
