"""Jobs by clicking."""

from __future__ import annotations

import re
from collections.abc import Mapping

from playwright.sync_api import Locator, expect

from tests.support.console.person import Person


def state_of(person: Person) -> Locator:
    """Where the page of a job says its state."""
    return person.page.locator(".headline .badge")


def job_of(person: Person) -> str:
    """The id of the job whose page is open."""
    expect(person.page).to_have_url(re.compile("/jobs/[0-9a-f-]{36}$"))
    return person.page.url.rpartition("/")[2]


def ended(person: Person) -> str:
    """Wait on the page of a job until it has succeeded; returns its id."""
    job = job_of(person)
    expect(state_of(person)).to_have_text(re.compile("SUCCEEDED|FAILED"))
    reason = person.page.locator(".headline .why").inner_text()
    assert state_of(person).inner_text() == "SUCCEEDED", f"{reason}: {person.page.get_by_role('log').text_content()}"
    return job


def submit(person: Person, task: str, fields: Mapping[str, str]) -> str:
    """Fill the wizard of a task and submit what its review shows; returns the id of the job."""
    page = person.goto("/submit")
    page.locator(f'a.card[href="/submit/task/{task}"]').click()
    for name, value in fields.items():
        page.locator(f'[name="{name}"]').fill(value)
    person.click("Review")
    expect(page.get_by_role("heading", name="Plan")).to_be_visible()
    person.leave("Submit")
    return job_of(person)
