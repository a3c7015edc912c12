"""Every page: read by axe, dark and light, on a phone, and with hostile texts in it."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import expect

from shared_store.volume.layout import Store
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import submit_gang
from tests.support.console.fixtures import Console
from tests.support.console.looks import assert_fit_a_phone, assert_no_faults
from tests.support.console.person import PHONE, People
from tests.support.orchestrator.jobs import await_status
from tests.support.orchestrator.models import add_model
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

HOSTILE = "</pre></textarea><script>alert(1)</script><img src=x onerror=alert(1)>{{ 7 * 7 }}"


@pytest.fixture(scope="module")
def places(console: Console) -> dict[str, str]:
    """The addresses of pages that have something to show, by a name."""
    store = Store(console.server.home / "store")
    add_model(store, "fast", "fast-run", 8)
    add_run(store, "taught", {**SPEC, "environment": {"TEXT": HOSTILE}})
    for iteration in (3, 6, 9):
        add_checkpoint(store, "taught", iteration, score=float(iteration), score_error=0.5)
    with MetricsWriter(store.run("taught"), 1, 0) as metrics:
        for iteration in range(1, 10):
            metrics.write({"iteration": iteration, "reward": iteration / 2, "reward_alive": 1.0, "policy_loss": 0.1})
    output = submit_gang(
        console.client, f"print({HOSTILE!r}); raise ValueError({HOSTILE!r})", name="hostile", cpus="0.5"
    )
    await_status(console.client, output, "FAILED")
    training = console.client.post("/api/runs/taught/resume", {"set": ["train.iterations=20"]})["jobId"]
    lists = {each: f"/{each}" for each in ("submit", "runs", "queues", "keys", "models")}
    runs = {"run": "/runs/taught", "compare": "/compare?run=taught", "model": "/models/fast"}
    jobs = {"jobs": "/", "training": f"/jobs/{training}", "command": f"/jobs/{output}", "missing": "/jobs/none"}
    forms = {"wizard": "/submit/task/Cartpole", "yaml": "/submit/yaml", "queue": "/queues?queue=lab"}
    return {**lists, **runs, **jobs, **forms}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_fault_on_any_page(console: Console, people: People, places: dict[str, str], scheme: Any) -> None:
    person = people(console.url, console.secrets["admin"], color_scheme=scheme)
    assert_no_faults(person, places, scheme)


def test_no_page_is_wider_than_a_phone(console: Console, people: People, places: dict[str, str]) -> None:
    person = people(console.url, console.secrets["admin"], viewport=PHONE, has_touch=True, is_mobile=True)
    assert_fit_a_phone(person, places)


def test_what_a_job_says_is_text_in_its_log(console: Console, people: People, places: dict[str, str]) -> None:
    person = people(console.url, console.secrets["admin"])
    page = person.goto(places["command"])
    expect(page.get_by_role("log").locator(".line").first).to_contain_text(HOSTILE)
    person.click("First error")
    expect(page.get_by_role("log").locator(".line.hit")).to_be_visible()
    assert page.locator("main img, main iframe, main script").count() == 0
    page = person.goto(places["training"])
    page.get_by_text("The whole job").click()
    expect(page.locator("details pre")).to_contain_text(HOSTILE)
    assert page.locator("main img, main iframe, main script").count() == 0


def test_a_text_that_is_typed_into_the_editors_stays_a_text(console: Console, people: People) -> None:
    person = people(console.url, console.secrets["admin"])
    page = person.goto("/submit/yaml")
    page.get_by_label("The job's YAML").fill(
        f"name: odd\nresources: {{cpus: 1, memory: 16}}\ncommand: [echo, '{HOSTILE}']\n"
    )
    person.click("Review")
    expect(page.locator("pre").first).to_contain_text(HOSTILE)
    assert page.locator("main img, main iframe, main script").count() == 0
    person.click("Back")
    expect(page.get_by_label("The job's YAML")).to_have_value(re.compile(re.escape(HOSTILE)))
