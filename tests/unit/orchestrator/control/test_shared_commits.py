"""Attempts that are worked on together: rows that they share, and commits whose answer is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import Status
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import Job, JobQueue
from orchestrator.persistence.session import Database, DatabaseError
from tests.support.orchestrator.fake_controller import FakeController, properties
from tests.support.waiting import wait_for

Bench = FakeController[FakeEngine]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as stack:
        yield FakeController(tmp_path, FakeEngine(capacity=Hosts([Host("fake/host", 8.0, (), 8192)])), stack)


def are(bench: Bench, status: Status, *names: str) -> Callable[[], bool]:
    return lambda: all(bench.job(name).status == status for name in names)


def test_what_a_request_changes_of_a_queue_counts_at_the_next_pass(bench: Bench) -> None:
    queue, passes = bench.controller.work_queue, bench.controller.admission

    def pass_of_now() -> bool:
        return bool(passes._passed[0] == queue.version)

    bench.submit("waits", queue="urgent", node_properties=properties(10))
    bench.submit("ends", queue="urgent", node_properties=properties(6))
    bench.ticks(are(bench, Status.RUNNING, "ends"))
    bench.engine.cluster.end("ends/1/1", 0, 0)
    bench.ticks(are(bench, Status.SUCCEEDED, "ends"))  # the loop has read the queue, to charge the share
    with bench.database.session() as session:
        session.get_one(JobQueue, "urgent").compute_environments = []
    bench.engine.offered = Hosts([Host("fake/host", 16.0, (), 16384)])
    bench.controller.engines.capacity(patience=10.0)
    queue.version += 1
    bench.ticks(pass_of_now)
    assert bench.job("waits").status == Status.RUNNABLE
    with bench.database.session() as session:
        session.get_one(JobQueue, "urgent").compute_environments = ["fake"]
    queue.version += 1
    bench.ticks(are(bench, Status.RUNNING, "waits"))


def test_an_attempt_whose_end_was_committed_without_an_answer_is_forgotten(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.submit("one", "two", node_properties=properties(1))
    bench.ticks(are(bench, Status.RUNNING, "one", "two"))
    check, lost = Database.check, list[str]()

    def checked(self: Database) -> None:
        check(self)
        if not lost and self.counts.by_status().get(Status.SUCCEEDED):
            lost.append("the answer to a commit")
            raise DatabaseError("the database does not answer")

    monkeypatch.setattr(Database, "check", checked)
    bench.engine.cluster.end("one/1/1", 0, 0)

    def passed() -> bool:
        try:
            bench.controller.tick()
        except DatabaseError as error:
            bench.controller._isolation.trouble = str(error)
        with bench.database.session() as session:
            return bool(lost) and session.get_one(Job, "one").status == Status.SUCCEEDED

    wait_for(passed, 30, "the end")
    bench.controller.tick()
    attempts = bench.controller.attempts
    assert list(attempts._open) == ["two"]
    [runner] = attempts.engine._runners.values()
    assert [handle.gang for handle in runner._observed] == ["two/1/1"]
