"""The database: its tables, commits that are made together, definitions that are read once, owners of runs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, or_, select
from sqlalchemy.exc import IntegrityError, OperationalError
from sqlalchemy.orm import Session

from orchestrator.control.writes import Writes
from orchestrator.domain.errors import ClientError
from orchestrator.domain.resources import Resources
from orchestrator.persistence.batch_models import Base, Job, JobQueue, RunRecord
from orchestrator.persistence.gangs import Gangs
from orchestrator.persistence.ownership import owner_of, record_owner
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import Database
from shared_store.volume.layout import Run, Store
from tests.support.orchestrator.rows import job


def test_a_first_start_that_is_interrupted_leaves_nothing_half_made(tmp_path: Path) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    jobs = Base.metadata.tables["jobs"]
    event.listen(jobs, "after_create", interrupted)
    try:
        with pytest.raises(KeyboardInterrupt):
            Database.at(tmp_path)
    finally:
        event.remove(jobs, "after_create", interrupted)
    database = Database.at(tmp_path)
    with database.session() as session:
        assert [queue.name for queue in session.scalars(select(JobQueue))] == ["default"]
    database.close()


class Crowd:
    """Callers that all wait while another one writes, then are carried out together."""

    def __init__(self, home: Path) -> None:
        nothing: Any = None  # additions ask neither the disk nor the loop
        self.database = Database.at(home)
        self.writes: Any = Writes(self.database, nothing, nothing)
        self.commits = 0
        event.listen(self.database.engine, "commit", self._count)

    def _count(self, connection: Any) -> None:
        self.commits += 1

    def call(self, *bodies: Callable[[Session], dict[str, Any]]) -> list[Any]:
        """What each call answered or raised."""
        with ThreadPoolExecutor(len(bodies)) as threads:
            with self.writes.lock:
                calls = [threads.submit(self.writes.gather, body) for body in bodies]
                while len(self.writes._pending) < len(bodies):
                    pass
            return [call.exception() or call.result() for call in calls]

    def stored(self) -> int:
        with self.database.session() as session:
            return session.scalar(select(func.count()).select_from(JobQueue)) or 0


@pytest.fixture
def crowd(tmp_path: Path) -> Crowd:
    return Crowd(tmp_path)


def adds(name: str) -> Callable[[Session], dict[str, Any]]:
    def body(session: Session) -> dict[str, Any]:
        session.add(JobQueue(name=name, priority=1, compute_environments=[]))
        return {"name": name}

    return body


def refuses(session: Session) -> dict[str, Any]:
    raise ClientError("no")


def test_calls_that_wait_together_are_committed_once_and_a_refusal_stops_nobody(crowd: Crowd) -> None:
    before, commits = crowd.stored(), crowd.commits
    one, no, two = crowd.call(adds("one"), refuses, adds("two"))
    assert (one, two) == ({"name": "one"}, {"name": "two"}) and isinstance(no, ClientError)
    assert (crowd.commits - commits, crowd.stored() - before) == (1, 2)


def test_a_call_that_the_database_refuses_fails_alone(crowd: Crowd) -> None:
    before = crowd.stored()
    found = crowd.call(adds("one"), adds("one"), adds("two"), refuses)
    assert sorted(type(each).__name__ for each in found) == ["ClientError", "IntegrityError", "dict", "dict"]
    assert found[2] == {"name": "two"} and crowd.stored() - before == 2
    assert isinstance(found[0], IntegrityError) != isinstance(found[1], IntegrityError)


def test_nothing_is_retried_after_a_failed_commit(crowd: Crowd) -> None:
    calls = []

    def lost(connection: Any) -> None:
        calls.append(1)
        raise OperationalError("COMMIT", {}, Exception("the connection broke"))

    event.listen(crowd.database.engine, "commit", lost)
    assert [type(each).__name__ for each in crowd.call(adds("one"), adds("two"))] == ["DatabaseError"] * 2
    assert len(calls) == 1


def properties(nodes: int) -> dict[str, Any]:
    container = {"command": ["x"], "resourceRequirements": [{"type": "VCPU", "value": "2"}]}
    ranges = [{"targetNodes": "0:", "container": container}]
    return {"numNodes": nodes, "mainNode": 0, "nodeRangeProperties": ranges}


def test_a_definition_is_read_once_however_often_its_row_is_loaded_until_the_row_changes() -> None:
    gangs = Gangs()
    first = gangs.of("j", properties(3))
    assert first.shape.nodes == (Resources(2, 0, 4),) * 3
    assert gangs.of("j", properties(3)) is first, "an equal document, decoded anew"
    with pytest.raises(ValueError, match="the job's row in the database is damaged"):
        gangs.of("j", {})
    assert len(gangs.of("j", properties(2)).nodes) == 2


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Store(tmp_path / "store").open().run("r")


def submitted(session: Session, name: str, queue: str, at: int) -> Job:
    added = job(name, run="r", queue=queue, owner=f"key {queue}", created_at=at)
    session.add(added)
    session.flush()
    return added


def recorded(session: Session, run: Run, job: Job) -> RunRecord:
    return record_owner(session, run, job, session.get(RunRecord, run.name))


def known(record: RunRecord | None) -> tuple[str, str | None] | None:
    return (record.queue, record.owner) if record else None


def test_a_run_belongs_to_its_first_job_until_a_later_one_creates_it(session: Session, run: Run) -> None:
    assert owner_of(session, run) is None
    submitted(session, "a", "robots", 1)
    later = submitted(session, "b", "lab", 2)
    assert known(owner_of(session, run)) == ("robots", "key robots")
    assert known(recorded(session, run, later)) == ("lab", "key lab")
    run.create({"run": "r", "queue": "other"})
    assert known(owner_of(session, run)) == ("lab", "key lab")  # the database's record comes first


def test_a_recreated_run_of_an_old_name_belongs_to_its_new_creator(session: Session, run: Run) -> None:
    first = submitted(session, "a", "robots", 1)
    recorded(session, run, first)
    run.create({"run": "r", "queue": "robots"})
    first.status = "SUCCEEDED"
    session.commit()
    shutil.rmtree(run.path)
    assert owner_of(session, run) is None, "no caller is refused a run that does not exist"
    second = submitted(session, "b", "lab", 2)
    assert known(owner_of(session, run)) == ("lab", "key lab"), "before it has started, too"
    recorded(session, run, second)
    run.create({"run": "r", "queue": "lab"})
    session.rollback()  # as where the controller is killed before it records the attempt
    assert known(owner_of(session, run)) == ("lab", "key lab")


def test_a_run_keeps_its_owner_while_the_volume_of_the_store_is_away(session: Session, run: Run) -> None:
    first = submitted(session, "a", "robots", 1)
    recorded(session, run, first)
    run.create({"run": "r", "queue": "robots"})
    first.status = "SUCCEEDED"
    store = run.path.parent.parent
    store.rename(store.with_name("away"))
    later = submitted(session, "b", "lab", 2)
    assert known(owner_of(session, run)) == known(recorded(session, run, later)) == ("robots", "key robots")


def test_an_existing_run_keeps_its_owner_whichever_job_continues_it(session: Session, run: Run) -> None:
    run.create({"run": "r", "queue": "robots", "owner": "key x"})
    later = submitted(session, "a", "lab", 1)
    assert known(recorded(session, run, later)) == ("robots", "key x")


@pytest.mark.parametrize("content", [b"{}", b"damaged", b'{"queue": 7}', b"[" * 100_000])
def test_a_run_without_a_queue_exists_and_has_no_owner(session: Session, run: Run, content: bytes) -> None:
    run.path.mkdir()
    (run.path / "run.json").write_bytes(content)
    assert known(owner_of(session, run)) == ("", None)
    assert known(recorded(session, run, submitted(session, "a", "lab", 1))) == ("lab", "key lab")


def stops(session: Session) -> list[tuple[str | None, bool]]:
    """Why each job is to end, and whether it was cancelled."""
    session.commit()
    found = session.scalars(select(Job).order_by(Job.id).execution_options(populate_existing=True))
    return [(each.stop_reason, each.cancelled) for each in found]


_CANCELLED, _TERMINATED, _LEFT = ("c", True), ("t", False), (None, False)


@pytest.mark.parametrize(
    ("children", "requests", "array", "ends"),
    [
        (["RUNNING", "RUNNING"], "c", _LEFT, [_LEFT, _LEFT]),
        (["RUNNING", "RUNNING"], "ct", _TERMINATED, [_TERMINATED, _TERMINATED]),
        (["RUNNING", "RUNNABLE"], "c", _CANCELLED, [_LEFT, _CANCELLED]),
        (["RUNNING", "RUNNABLE"], "ct", _TERMINATED, [_TERMINATED, _CANCELLED]),
        (["RUNNING", "RUNNABLE"], "ctc", _TERMINATED, [_TERMINATED, _CANCELLED]),
        (["RUNNING", "RUNNABLE"], "tc", _TERMINATED, [_TERMINATED, _TERMINATED]),
        (["PENDING", "SUBMITTED"], "c", _CANCELLED, [_CANCELLED, _CANCELLED]),
        (["PENDING", "SUBMITTED"], "ct", _CANCELLED, [_CANCELLED, _CANCELLED]),
        (["PENDING", "SUBMITTED"], "tc", _TERMINATED, [_TERMINATED, _TERMINATED]),
        (["SUCCEEDED", "FAILED"], "tc", _LEFT, [_LEFT, _LEFT]),
        (["SUCCEEDED", "STARTING"], "ct", _TERMINATED, [_LEFT, _TERMINATED]),
    ],
)
def test_an_array_is_asked_to_end_by_the_request_that_asked_its_children(
    session: Session, children: list[str], requests: str, array: object, ends: list[object]
) -> None:
    """``c``: cancelled, ``t``: terminated; each is sent twice, the second time with another reason."""
    session.add(job("a", kind="array", status="PENDING", array_size=2))
    session.flush()
    for index, status in enumerate(children):
        session.add(job(f"a:{index}", kind="container", parent="a", array_index=index, status=status))
    session.commit()
    for request in requests:
        for reason in (request, "again"):
            ask_to_end(session, or_(Job.id == "a", Job.parent == "a"), reason, cancel=request == "c")
    assert stops(session) == [array, *ends]


def test_a_child_that_is_ended_alone_leaves_its_array_alone(session: Session) -> None:
    session.add_all([job("a", kind="array", status="PENDING"), job("a:0", parent="a"), job("a:1", parent="a")])
    session.commit()
    ask_to_end(session, Job.id == "a:1", "c", cancel=True)
    assert stops(session) == [_LEFT, _LEFT, _CANCELLED]
