"""Stops of gangs: who waits for whom, and what the users of those that wait are shown."""

from __future__ import annotations

import logging
import threading
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy.orm import Session

from orchestrator.control import stops
from orchestrator.control.stops import Stops
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import Status
from orchestrator.engines.api import EngineError, GangStatus, Handle, read_handle
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.queries import ask_to_end
from tests.support.orchestrator.fake_controller import FakeController
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


def test_why_a_gang_can_not_be_stopped_stays_its_reason_at_every_further_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stops, "_AGAIN", 0.05)
    tries, commit, reasons = list[str](), Session.commit, list[str | None]()

    def deny(engine: FakeEngine, handle: Handle, grace: float) -> None:
        tries.append(handle.gang)
        raise EngineError("not authorized")

    def noted(session: Session) -> None:
        of_jobs = [each.status_reason for each in session if isinstance(each, Job) and each.status == Status.RUNNING]
        commit(session)
        reasons.extend(of_jobs)

    monkeypatch.setattr(FakeEngine, "stop", deny)
    with ExitStack() as stack:
        bench = FakeController(tmp_path, FakeEngine(capacity=Hosts([Host("fake/host", 8.0, (), 8192)])), stack)
        bench.submit("a")
        bench.ticks(lambda: bench.job("a").status == Status.RUNNING)
        with bench.database.session() as session:
            ask_to_end(session, Job.id == "a", "enough")
        monkeypatch.setattr(Session, "commit", noted)
        bench.ticks(lambda: len(tries) > 3)
    denied = "attempt 1 can't be stopped: not authorized; trying again"
    assert "enough; its nodes are ending" in reasons
    first = reasons.index(denied)
    assert set(reasons[first:]) == {denied}
