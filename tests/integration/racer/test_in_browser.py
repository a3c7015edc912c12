"""The racer's wizard and the editor of its code, in a real browser."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.conftest import Serving
from tests.support.console.person import People

NAME = "train.config.reward_function"
MESSAGE = f'[data-wrong="{NAME}"]'
BAD = re.compile(r"\bbad\b")


@pytest.fixture
def browser_page(shared_server: Serving, people: People) -> Page:
    return people(shared_server.url).page


@pytest.fixture
def code(browser_page: Page) -> Locator:
    """The editor of the reward function in the racer's wizard."""
    browser_page.goto("/submit/task/Racer")
    field = browser_page.locator(f'textarea[name="{NAME}"]')
    expect(field.locator("xpath=../div").locator("span").first).to_have_text("1")  # the script has begun
    return field


def numbers(code: Locator) -> Locator:
    return code.locator("xpath=..").locator(".numbers span")


def test_the_line_of_a_mistake_is_marked_while_a_person_types(browser_page: Page, code: Locator) -> None:
    code.fill("def reward_function(params):")
    code.press("End")
    code.press("Enter")
    browser_page.keyboard.type("return open")
    assert code.input_value() == "def reward_function(params):\n    return open", "the new line is indented"
    expect(browser_page.locator(MESSAGE)).to_contain_text("reward_function.py:2: FORBIDDEN: open")
    expect(numbers(code).nth(1)).to_have_class(BAD)
    expect(code).to_have_attribute("aria-invalid", "true")
    expect(browser_page.locator("[data-yaml]")).to_contain_text("return open")
    for _ in "open":
        browser_page.keyboard.press("Backspace")
    browser_page.keyboard.type("1.0")
    expect(browser_page.locator(MESSAGE)).to_be_hidden()
    expect(numbers(code).nth(1)).not_to_have_class(BAD)


def test_tab_indents_and_escape_lets_whoever_has_no_mouse_leave(browser_page: Page, code: Locator) -> None:
    code.fill("a\nb")
    code.press("Tab")
    assert code.input_value() == "a\nb    "
    code.press("Control+z")
    assert code.input_value() == "a\nb", "what was inserted can be undone"
    code.press("Home")
    code.press("Tab")
    code.press("Shift+Tab")
    assert code.input_value() == "a\nb"
    expect(code).to_be_focused()
    code.press("Escape")
    code.press("Tab")
    expect(code).not_to_be_focused()
    code.focus()
    code.press("Escape")
    code.press("Shift+Tab")
    expect(code).not_to_be_focused()


def test_the_wizard_leads_by_review_and_yaml_to_jobs(browser_page: Page, code: Locator, shared_server: Serving) -> None:
    code.fill("# </script><script>alert(1)</script>\ndef reward_function(params):\n    return 1.0\n")
    browser_page.locator('[name="name"]').fill("clicked")
    browser_page.locator('select[name="train.algorithm"]').select_option("sac")
    expect(browser_page.locator('[data-algorithm="ppo"]').first).to_be_hidden()
    expect(browser_page.locator('[data-algorithm="sac"]').first).to_be_visible()
    browser_page.locator('select[name="train.algorithm"]').select_option("ppo")
    browser_page.get_by_role("button", name="Review").click()
    expect(browser_page.get_by_role("heading", name="Review clicked")).to_be_visible()
    browser_page.get_by_role("button", name="Edit as YAML").click()
    text = browser_page.locator('textarea[name="yaml"]')
    fields = text.input_value()
    text.fill(fields.replace("worlds", "wordls"))
    expect(browser_page.locator('[data-wrong="yaml"]')).to_contain_text("did you mean worlds?")
    expect(browser_page.locator(".numbers .bad")).to_have_count(1)
    text.fill(fields + "priority: 3\n")
    expect(browser_page.locator("[data-help-key]")).to_contain_text("greater is served first")
    browser_page.get_by_role("button", name="Review").click()
    browser_page.route("**/jobs/*", lambda route: route.fulfill(body="the job"))  # its page is not of this test
    browser_page.get_by_role("button", name="Submit").click()
    browser_page.wait_for_url("**/jobs/*")
    job = browser_page.url.rpartition("/")[2]
    spec = shared_server.client.get(f"/api/jobs/{job}")["spec"]
    assert (spec["name"], spec["priority"]) == ("clicked", 3)
    assert spec["train"]["config"]["reward_function"]["text"].startswith("# </script><script>")
    shared_server.client.batch("TerminateJob", jobId=job, reason="seen")
