"""Stops of gangs: who waits for whom, and what the users of those that wait are shown."""

from __future__ import annotations

import logging
import threading
from types import SimpleNamespace

import pytest

from orchestrator.control import stops
from orchestrator.control.stops import Stops
from orchestrator.engines.api import GangStatus, Handle, read_handle
from tests.support.waiting import wait_for


def test_a_stop_waits_for_those_of_its_own_engine_alone_and_its_reason_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops, "_THREADS", 2)
    monkeypatch.setattr(stops, "_QUIET", 0.1)
    answers, changed = threading.Event(), list[str]()

    def stop(handle: str, grace: float) -> GangStatus:
        if read_handle(handle).engine == "docker":
            answers.wait()
        return []

    engine = SimpleNamespace(stop=stop)
    requested = Stops(engine, changed.append, logging.getLogger("test"))  # type: ignore[arg-type]

    def ask(job: str, engine: str) -> GangStatus | None:
        return requested.ask((job, 1), Handle(engine, f"{job}/1/1", 1, {}).text(), 30.0)

    try:
        for job in ("a", "b", "c"):
            assert ask(job, "docker") is None
        ask("d", "slurm")
        wait_for(lambda: ask("d", "slurm") == [], 2, "a stop on an engine that answers")
        assert 0 < requested.pause(("c", 1)) <= 0.1 or requested.reason(("c", 1))
        wait_for(lambda: requested.reason(("c", 1)), 2, "that it says so, once it has waited for a while")
        assert [requested.reason((job, 1)) for job in ("a", "b", "d")] == [None] * 3
        waits = "attempt 1 waits for its turn to be stopped: the docker engine is stopping 2 others"
        assert requested.reason(("c", 1)) == waits and requested.has_started(("c", 1))
        answers.set()
        wait_for(lambda: changed.count("c") == 2, 2, "that it has begun, and has returned")
        assert requested.reason(("c", 1)) == "attempt 1 is being stopped"
        assert ask("c", "docker") == [] and requested.reason(("c", 1)) is None
    finally:
        answers.set()
        requested.close()
