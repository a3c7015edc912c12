"""The page of a job in a real browser: its log is read, searched and followed, and what a job says stays text."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from shared_store.layout import Store
from shared_store.metrics import MetricsWriter
from tests.conftest import Serving, submit_gang, wait_for
from tests.support.browser import Browser
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


class Tab:
    """A page of the browser, asked in JavaScript."""

    def __init__(self, url: str, home: Path) -> None:
        self.browser, self.url = Browser(url, home), url

    def tell(self, script: str) -> Any:
        answer = self.browser.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def see(self, script: str) -> Any:
        """What a script gives, once that is something."""
        return wait_for(lambda: self.tell(script), 20, script)


@pytest.fixture
def tab(server: Serving, tmp_path: Path) -> Iterator[Tab]:
    """The page of a job that has said a thousand lines and runs."""
    job = submit_gang(server.client, SCRIPT, name="talks")
    server.wait(job, "RUNNING")
    wait_for(lambda: "line 999" in server.log(job), 20, "the last line")
    tab = Tab(f"{server.url}/jobs/{job}", tmp_path / "browser")
    yield tab
    tab.browser.close()


def test_the_log_is_read_back_searched_and_followed_and_stays_text(tab: Tab) -> None:
    tab.see(f"{LINES}.at(-1) === 'line 999'")
    assert tab.tell(f"{LINES}.length") == 400
    for _ in range(2):
        count = tab.tell(f"{LINES}.length")
        tab.tell("document.querySelector('[data-earlier]').click()")
        tab.see(f"{LINES}.length > {count}")
    lines = tab.tell(LINES)
    assert [each for each in lines if each.startswith("line ")] == [f"line {i}" for i in range(1000)]
    assert '<img src=x onerror="document.title=1"> red \ufffdgnp' in lines
    assert tab.tell("document.title.startsWith('talks') && document.querySelectorAll('[data-log] img').length === 0")
    tab.tell("document.querySelector('[data-first-error]').click()")
    tab.see("document.querySelector('.line.hit')?.textContent.endsWith('ValueError: the reason')")
    assert tab.tell("!document.querySelector('[data-follow]').hidden")
    tab.tell("document.querySelector('[data-follow]').click()")
    tab.see(f"{LINES}.at(-1) === 'line 999'")
    form = "document.querySelector('[data-log-filter]')"
    tab.tell(f"{form}.elements.text.value = 'LINE 77'; {form}.requestSubmit()")
    tab.see(f"{STATE} === '11 lines with this text'")
    assert {urlsplit(each).netloc for each in tab.browser.asked} <= {urlsplit(tab.url).netloc, ""}


def test_a_job_is_stopped_in_its_dialog_and_the_page_follows_to_the_end(tab: Tab) -> None:
    tab.see("document.querySelector('.badge')?.textContent === 'RUNNING'")
    tab.see(f"{LINES}.at(-1) === 'line 999'")
    tab.tell("[...document.querySelectorAll('button')].find((each) => each.textContent === 'Stop').click()")
    tab.see("document.querySelector('dialog[open] h2')?.textContent.startsWith('Stop talks')")
    tab.tell("document.querySelector('dialog button.danger').click()")
    tab.see("document.querySelector('.badge')?.textContent === 'FAILED'")
    assert tab.tell("document.querySelector('.headline .why').textContent").startswith("stopped in the console by")
    tab.see(f"{LINES}.at(-1).startsWith('node 0 ended')")
    assert tab.tell("document.querySelector('[data-attempts] .span').dataset.state") == "stopped"


def test_curves_are_drawn_and_a_window_of_them_is_read_again(server: Serving, tmp_path: Path) -> None:
    store = Store(server.home / "store")
    add_run(store, "taught", SPEC)
    add_checkpoint(store, "taught", 6)
    with MetricsWriter(store.run("taught"), 1, 0) as metrics:
        for iteration in range(1, 2001):
            terms = {f"reward_term_{i}": iteration * i for i in range(8)}
            metrics.write({"iteration": iteration, "env_steps": 10 * iteration, "reward": iteration % 7, **terms})
    server.wait(submit_gang(server.client, "import time; time.sleep(3600)", cpus="0.5"), "RUNNING")
    job = server.client.post("/api/runs/taught/resume", {"set": ["train.iterations=9000", "resources.cpus=4"]})
    tab = Tab(f"{server.url}/jobs/{job['jobId']}", tmp_path / "browser")
    try:
        assert int(tab.see("document.querySelector('.chart')?.dataset.points")) == 300
        assert tab.tell("document.querySelectorAll('.chart')[1].querySelectorAll('path.curve.dashes-1').length") == 4
        tab.tell(
            "document.querySelector('.chart').dispatchEvent(new CustomEvent('window', {detail: {from: 1, to: 50}}))"
        )
        tab.see("document.querySelector('.chart').dataset.points === '50'")
        tab.tell("document.querySelector('[data-whole]').click()")
        tab.see("document.querySelector('.chart').dataset.points === '300'")
    finally:
        tab.browser.close()
