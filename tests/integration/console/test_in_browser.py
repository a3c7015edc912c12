"""The wizard, its code editor and the page of a job in a real browser; what a job says stays text."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from shared_store.volume.layout import Store
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import Serving, submit_gang, wait_for
from tests.support.console.person import People
from tests.support.orchestrator.jobs import FOREVER
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

# -- the wizard and its editor -----------------------------------------------------------------------------------------


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
    given = text.input_value()
    text.fill(given.replace("worlds", "wordls"))
    expect(browser_page.locator('[data-wrong="yaml"]')).to_contain_text("did you mean worlds?")
    expect(browser_page.locator(".numbers .bad")).to_have_count(1)
    text.fill(given + "priority: 3\n")
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


# -- the page of a job -------------------------------------------------------------------------------------------------


SCRIPT = """
import time
print('<img src=x onerror="document.title=1"> \\x1b[31mred\\x1b[0m \\u202egnp', flush=True)
for i in range(900): print('line', i, flush=True)
print('ValueError: the reason', flush=True)
for i in range(900, 1000): print('line', i, flush=True)
time.sleep(3600)
"""
LINES = "[...document.querySelectorAll('[data-log] .line span:last-child')].map((each) => each.textContent)"
STATE = "document.querySelector('[data-log-state]').textContent"


def see(page: Page, script: str) -> Any:
    """What a script gives, once that is something."""
    return wait_for(lambda: page.evaluate(script), 20, script)


def test_the_log_is_read_back_searched_and_followed_and_stays_text(shared_server: Serving, people: People) -> None:
    job = submit_gang(shared_server.client, SCRIPT, name="talks")
    wait_for(lambda: "line 999" in shared_server.log(job), 20, "the last line")
    page = people(shared_server.url).goto(f"/jobs/{job}")
    see(page, f"{LINES}.at(-1) === 'line 999'")
    assert page.evaluate(f"{LINES}.length") == 400
    for _ in range(2):
        count = page.evaluate(f"{LINES}.length")
        page.evaluate("document.querySelector('[data-earlier]').click()")
        see(page, f"{LINES}.length > {count}")
    lines = page.evaluate(LINES)
    assert [each for each in lines if each.startswith("line ")] == [f"line {i}" for i in range(1000)]
    assert '<img src=x onerror="document.title=1"> red \ufffdgnp' in lines
    assert page.evaluate("document.title.startsWith('talks')")
    assert page.evaluate("document.querySelectorAll('[data-log] img').length") == 0
    page.evaluate("document.querySelector('[data-first-error]').click()")
    see(page, "document.querySelector('.line.hit')?.textContent.endsWith('ValueError: the reason')")
    assert page.evaluate("!document.querySelector('[data-follow]').hidden")
    page.evaluate("document.querySelector('[data-follow]').click()")
    see(page, f"{LINES}.at(-1) === 'line 999'")
    form = "document.querySelector('[data-log-filter]')"
    page.evaluate(f"{form}.elements.text.value = 'LINE 77'; {form}.requestSubmit()")
    see(page, f"{STATE} === '11 lines with this text'")
    shared_server.client.batch("TerminateJob", jobId=job, reason="seen")


def test_curves_are_drawn_and_a_window_of_them_is_read_again(shared_server: Serving, people: People) -> None:
    store = Store(shared_server.home / "store")
    add_run(store, "curved", SPEC)
    add_checkpoint(store, "curved", 6)
    with MetricsWriter(store.run("curved"), 1, 0) as metrics:
        for iteration in range(1, 2001):
            terms = {f"reward_term_{i}": iteration * i for i in range(8)}
            terms |= {"explained_variance": 0.5, "kl": 0.25}
            metrics.write({"iteration": iteration, "env_steps": 10 * iteration, "reward": iteration % 7, **terms})
    blocker = submit_gang(shared_server.client, FOREVER, cpus="0.5")
    shared_server.wait(blocker, "RUNNING")
    changes = {"set": ["train.iterations=9000", "resources.cpus=8"]}  # it waits
    job = shared_server.client.post("/api/runs/curved/resume", changes)["jobId"]
    page = people(shared_server.url).goto(f"/jobs/{job}")
    assert int(see(page, "document.querySelector('.chart')?.dataset.points")) == 300
    assert page.evaluate("document.querySelectorAll('.chart')[1].querySelectorAll('path.curve.dashes-1').length") == 4
    for label in ("KL divergence [nat]", "Explained variance"):
        expect(page.get_by_text(label, exact=True)).to_be_visible()
    window = "new CustomEvent('window', {detail: {from: 1, to: 50}})"
    page.evaluate(f"document.querySelector('.chart').dispatchEvent({window})")
    see(page, "document.querySelector('.chart').dataset.points === '50'")
    page.evaluate("document.querySelector('[data-whole]').click()")
    see(page, "document.querySelector('.chart').dataset.points === '300'")
    for each in (job, blocker):
        shared_server.client.batch("TerminateJob", jobId=each, reason="seen")


def test_the_page_of_a_run_renews_how_it_learns(shared_server: Serving, people: People) -> None:
    store = Store(shared_server.home / "store")
    add_run(store, "learns", {**SPEC, "name": "learns"})
    with MetricsWriter(store.run("learns"), 1, 0) as metrics:
        metrics.write({"iteration": 1, "reward": 1.0, "action_std": 0.5})
        page = people(shared_server.url).goto("/runs/learns")
        expect(page.locator("[data-progress]")).to_have_text(
            re.compile(r"^\s*Learning\s*deviation of actions 0.5\s*Warning\s*$")
        )
        expect(page.get_by_text("Warning", exact=True)).to_be_hidden()
        metrics.write({"iteration": 2, "reward": 1.0, "action_std": 0.25, "warnings": ["it unlearns: (RUN@best)"]})
        expect(page.get_by_text("deviation of actions 0.25", exact=True)).to_be_visible()
        expect(page.get_by_text("it unlearns: (learns@best)", exact=True)).to_be_visible()
