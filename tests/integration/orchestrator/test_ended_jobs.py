"""What a controller keeps of jobs, queues and trainings that have ended, and what it reports of those that run."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from sqlalchemy import select

from orchestrator.control.attempts import Attempts
from orchestrator.control.exposition import exposition
from orchestrator.domain.attempt import AttemptState
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import Status
from orchestrator.engines.api import Gang, Handle, NotYet, Plan
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import Job, JobQueue
from tests.support.orchestrator.fake_controller import FakeController, properties
from tests.support.waiting import wait_for


class FullEngine(FakeEngine):
    """It has no room while it is full."""

    is_full = False

    def launch(self, plan: Plan[Gang]) -> Handle:
        if self.is_full:
            raise NotYet("no room yet")
        return super().launch(plan)


Bench = FakeController[FullEngine]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as stack:
        made = FakeController(tmp_path, FullEngine(capacity=Hosts([Host("fake/large", 64.0, (), 65536)])), stack)
        made.controller.start()
        yield made


def series(bench: Bench, name: str) -> list[str]:
    return [line for line in exposition(bench.controller).decode().splitlines() if line.startswith(name)]


def stop(bench: Bench, name: str) -> None:
    with bench.database.session() as session:
        session.get_one(Job, name).stop_reason = "enough"
    bench.wait(name, Status.FAILED)


def test_nothing_of_an_attempt_stays_in_memory_once_its_job_has_ended_or_it_was_withdrawn(bench: Bench) -> None:
    gc.collect()
    before = {id(each) for each in gc.get_objects() if isinstance(each, AttemptState | Handle)}
    bench.runs_and_ends("a", "b")
    bench.submit("stopped")
    bench.wait("stopped", Status.RUNNING)
    stop(bench, "stopped")
    bench.engine.is_full = True
    bench.submit("waits")
    bench.explains("waits", "no room yet")
    stop(bench, "waits")
    attempts: Attempts = bench.controller.attempts

    def kept() -> list[AttemptState | Handle]:
        gc.collect()
        return [each for each in gc.get_objects() if isinstance(each, AttemptState | Handle) and id(each) not in before]

    wait_for(lambda: not kept() and not attempts._open, 10, "that nothing is kept")


def test_series_of_a_queue_end_with_it(bench: Bench) -> None:
    bench.submit("urgent", queue="urgent")
    bench.runs_and_ends("a")
    bench.wait("urgent", Status.RUNNING)
    with bench.database.session() as session:
        queue = session.get_one(JobQueue, "urgent")
        queue.deleting = True
        bench.controller.upkeep.drain(session, queue)
    bench.wait("urgent", Status.FAILED)
    gone = "that the queue is gone"

    def queues() -> list[str]:
        with bench.database.session() as session:
            return list(session.scalars(select(JobQueue.name)))

    wait_for(lambda: "urgent" not in queues(), 30, gone)
    wait_for(lambda: not [line for line in series(bench, "muster_") if 'queue="urgent"' in line], 30, gone)
    assert series(bench, 'muster_attempts_ended_total{ending="succeeded",engine="fake",queue="default"} 1.0')
    assert series(bench, 'muster_queue_wait_seconds_count{queue="default"} 1.0')


def test_a_bounded_number_of_trainings_has_series_and_the_others_are_counted(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrator.control.exposition._TRAININGS", 2)
    names = ["a", "b", "c", "command"]
    bench.submit(*names, node_properties=properties(1, 1))
    for name in names:
        bench.wait(name, Status.RUNNING)
    assert series(bench, "muster_trainings_left_out") == ["muster_trainings_left_out 0.0"]
    progress = {(name, 1, 0): {"iteration": 3, "steps_per_second": 7.5} for name in names[:3]}
    monkeypatch.setattr(bench.controller.bus, "progress", lambda *node: progress.get(node))
    assert len(series(bench, "muster_training_iteration{")) == 2
    assert len(series(bench, "muster_training_steps_per_second{")) == 2
    assert series(bench, "muster_trainings_left_out") == ["muster_trainings_left_out 1.0"]
    del progress["a", 1, 0]
    assert len(series(bench, "muster_training_iteration{")) == 2
    assert series(bench, "muster_trainings_left_out") == ["muster_trainings_left_out 0.0"]
