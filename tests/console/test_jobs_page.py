"""The list of jobs: two people at once, no mouse, hostile texts."""

from __future__ import annotations

import pytest
from playwright.sync_api import Locator, expect

from tests.support.console.fixtures import Console, secret_of
from tests.support.console.person import People, Person
from tests.support.orchestrator.jobs import await_status

HOSTILE = "</td><script>alert(1)</script><img src=x onerror=alert(1)>{{ 7 * 7 }}"


@pytest.fixture(scope="module")
def waiting(console: Console) -> str:
    """The definition of jobs that wait."""
    return console.register("waits")


def row(person: Person, job: str) -> Locator:
    return person.page.locator(f'tr[data-key="{job}"]')


def test_two_people_see_changes_and_a_reader_has_no_buttons(console: Console, people: People, waiting: str) -> None:
    one, other = people(console.url, console.secrets["admin"]), people(console.url, console.secrets["reader"])
    for each in (one, other):
        each.goto("/")
    job = console.submit(waiting, "shared")
    for each in (one, other):
        expect(row(each, job)).to_contain_text("shared")
    expect(other.page.get_by_role("button", name="Stop marked")).to_have_count(0)
    row(one, job).get_by_role("checkbox").check()
    row(one, job).get_by_role("link").focus()
    later = console.submit(waiting, "shared-later")
    expect(row(one, later)).to_be_visible()
    console.client.batch("TerminateJob", jobId=later, reason="seen")
    expect(row(one, later).locator(".badge")).to_have_text("FAILED")
    expect(row(one, job).get_by_role("link")).to_be_focused()
    expect(row(one, job).get_by_role("checkbox")).to_be_checked()
    one.click("Stop marked")
    one.confirm()
    for each in (one, other):
        expect(row(each, job).locator(".badge")).to_have_text("FAILED")


def test_a_job_is_stopped_without_a_mouse(console: Console, people: People, waiting: str) -> None:
    person = people(console.url, console.secrets["admin"])
    job = console.submit(waiting, "by-keyboard")
    page = person.goto("/?search=by-keyboard")
    tab_to(person, "a.skip")
    page.keyboard.press("Enter")
    tab_to(person, f'tr[data-key="{job}"] input[type=checkbox]')
    page.keyboard.press("Space")
    tab_to(person, "#stop button.danger", backwards=True)
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_role("button", name="Cancel")).to_be_focused()
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    expect(row(person, job).locator(".badge")).to_have_text("FAILED")


def test_a_job_is_submitted_by_the_wizard_without_a_mouse(console: Console, people: People) -> None:
    person = people(console.url, console.secrets["admin"])
    page = person.goto("/")
    for link in ('nav a[href="/submit"]', 'a[href="/submit/task/Cartpole"]'):
        tab_to(person, link)
        page.keyboard.press("Enter")
        page.wait_for_url(f"**{link.split(chr(34))[1]}")
    tab_to(person, "input[name=name]")
    page.keyboard.press("Control+A")
    page.keyboard.type("typed")
    tab_to(person, "aside button.main", backwards=True)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Review typed")).to_be_visible()
    tab_to(person, 'form[action="/submit"] button')
    page.keyboard.press("Enter")
    page.wait_for_url("**/jobs/*")
    expect(page.get_by_role("heading", level=1)).to_contain_text("typed")
    console.client.batch("TerminateJob", jobId=page.url.rpartition("/")[2], reason="seen")


def test_an_open_page_leads_to_the_login_once_its_key_is_gone(console: Console, people: People, waiting: str) -> None:
    person = people(console.url, secret_of(console.keys.create("passing")))
    page = person.goto("/?search=shared")
    job = console.submit(waiting, "shared-later")
    expect(row(person, job)).to_be_visible()
    console.keys.delete("passing")
    page.wait_for_url("**/login?next=*")
    page.get_by_label("Key, as").fill(console.secrets["admin"])
    page.keyboard.press("Enter")
    page.wait_for_url("**/?search=shared")
    expect(row(person, job)).to_be_visible()
    console.client.batch("TerminateJob", jobId=job, reason="seen")


def tab_to(person: Person, selector: str, backwards: bool = False) -> None:
    """Press Tab until an element has the focus. Raises AssertionError: it can't be reached."""
    for _ in range(60):
        person.page.keyboard.press("Shift+Tab" if backwards else "Tab")
        if person.page.evaluate("selector => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"{selector} can't be reached with Tab")


def test_hostile_names_and_reasons_are_text(console: Console, people: People, waiting: str) -> None:
    job = console.submit(waiting, "hostile")
    console.client.batch("TerminateJob", jobId=job, reason=HOSTILE)
    await_status(console.client, job, "FAILED")
    person = people(console.url, console.secrets["admin"])
    person.goto("/")
    expect(row(person, job).locator(".reason")).to_have_text(HOSTILE)
    second = console.submit(waiting, "hostile-later")
    expect(row(person, second)).to_be_visible()
    console.client.batch("TerminateJob", jobId=second, reason=HOSTILE)
    expect(row(person, second).locator(".reason")).to_have_text(HOSTILE)
    page = person.goto(f"/?search={HOSTILE}".replace("#", "%23"))
    expect(page.get_by_label("Search")).to_have_value(HOSTILE)
    assert page.locator("img, iframe, main script").count() == 0
