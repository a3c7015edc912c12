"""Live views in pages of jobs: when one starts and ends, with real processes in place of the viewer."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any, cast

import pytest

from orchestrator.api.errors import ClientError
from orchestrator.console import job_view
from orchestrator.console.job_view import State, Views
from tests.conftest import wait_for
from tests.support.console.fixtures import Console

OPEN = "import time; print('note: 2 worlds'); print('the view is at http://127.0.0.1:9', flush=True); time.sleep(600)"
SHOWN = State(url="http://127.0.0.1:9")


def script(text: str) -> list[str]:
    return [sys.executable, "-c", text]


def shown(views: Views, job: str, state: State) -> None:
    wait_for(lambda: views.state(job) == state, 20, f"{job}: {state}")


def test_a_view_is_open_until_it_is_closed_and_a_server_has_two_at_once() -> None:
    views = Views()
    assert views.state("a") == State()
    views.start("a", script(OPEN))
    views.start("b", script(OPEN))
    assert views.state("a").text == "starting"
    for job in ("a", "b"):
        shown(views, job, SHOWN)
    views.start("a", script("raise SystemExit(3)"))
    assert views.state("a") == SHOWN, "it is open already"
    with pytest.raises(ClientError, match="2 live views are open on this server; close one first"):
        views.start("c", script(OPEN))
    views.end("a")
    shown(views, "a", State())
    views.start("c", script(OPEN))
    shown(views, "c", SHOWN)
    for job in ("b", "c", "nobody's"):
        views.end(job)
        shown(views, job, State())


def test_the_reason_of_a_view_that_ends_is_its_last_line() -> None:
    views = Views()
    views.start("a", script("print('muster: the training is on another machine'); raise SystemExit(1)"))
    shown(views, "a", State(problem="the training is on another machine"))
    views.start("a", script("raise SystemExit(3)"))
    shown(views, "a", State(problem="exit code 3"))


def test_a_view_ends_when_nobody_looks_at_its_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_view, "_UNSEEN", 2.0)
    views = Views()
    views.start("a", script(OPEN))
    wait_for(lambda: views.state("a", is_seen=True) == SHOWN, 20, "the view")
    shown(views, "a", State())


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("LOCALHOST", "http://localhost:80"),
        ("[::1]:8080", "http://[::1]:8080"),
        ("127.0.0.1:8080; script-src *", None),
        ("127.0.0.1 *", None),
        ("robots.example:8080", None),
        ("", None),
    ],
)
def test_a_viewer_may_be_framed_by_the_console_of_this_machine_alone(host: str, origin: str | None) -> None:
    request = cast(Any, SimpleNamespace(headers={"host": host}, url=SimpleNamespace(scheme="http")))
    assert job_view.is_near(request) == (origin is not None)
    if origin is not None:
        assert job_view._origin(request) == origin


def test_what_can_t_be_watched_is_refused_in_one_line(console: Console) -> None:
    job = console.submit(console.register("waits"), "waits")
    answer = console.visitor().submit(f"/jobs/{job}/view")
    assert answer.status_code == 409
    assert answer.json()["message"] == "job waits is no training that runs; its checkpoints can be recorded"
    assert console.visitor("reader").submit(f"/jobs/{job}/view").status_code == 403
    far = console.visitor().http.post(f"/jobs/{job}/view", headers={"Host": "robots.example", "Accept": "*/*"})
    assert far.status_code == 403
    console.client.batch("TerminateJob", jobId=job, reason="seen")
