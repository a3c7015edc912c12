"""A track made by clicking, after a mistake that is shown at its field."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.support.console.fixtures import Console
from tests.support.console.person import People


def test_a_track_is_made_after_a_mistake_was_shown_at_its_field(console: Console, people: People) -> None:
    person = people(console.url, console.secrets["admin"])
    page = person.goto("/tracks")
    page.get_by_text("Make a track").click()
    page.get_by_label("Name", exact=True).fill("hills")
    page.get_by_label("Least radius").fill("40")
    page.get_by_label("Length").fill("45")
    person.click("Make")
    expect(page.locator("[data-message]")).to_contain_text("radius")
    page.get_by_label("Least radius").fill("")
    page.get_by_label("Seed, of").fill("9999999999999999999")
    person.click("Make")
    seed = page.get_by_label("Seed, of")
    expect(seed).to_be_focused()
    assert str(seed.evaluate("field => field.validationMessage")).startswith("seed: expected a value less than")
    seed.fill("7")
    person.leave("Make")
    expect(page.get_by_role("heading", name="Track hills")).to_be_visible()
    expect(page.get_by_role("main")).to_contain_text("45.00 m")
