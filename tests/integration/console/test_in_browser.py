"""The page of a job in a real browser; what a job says stays text."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, expect

from shared_store.volume.layout import Store
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import Serving, submit_gang, wait_for
from tests.support.console.person import People
from tests.support.orchestrator.jobs import FOREVER
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

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
