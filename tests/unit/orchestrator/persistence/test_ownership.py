"""Whose a run is, by the database, the store and the jobs."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy.orm import Session

from orchestrator.persistence.models import Job, RunRecord
from orchestrator.persistence.ownership import owner_of, record_owner
from orchestrator.persistence.session import Database
from shared_store.layout import Run, Store
from tests.support.orchestrator.rows import job


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    database = Database.at(tmp_path)
    with database.session() as session:
        yield session
    database.close()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Store(tmp_path / "store").open().run("r")


def submitted(session: Session, name: str, queue: str, at: int) -> Job:
    added = job(name, run="r", queue=queue, owner=f"key {queue}", created_at=at)
    session.add(added)
    session.flush()
    return added


def known(record: RunRecord | None) -> tuple[str, str | None] | None:
    return (record.queue, record.owner) if record else None


def test_a_run_belongs_to_its_first_job_until_a_later_one_creates_it(session: Session, run: Run) -> None:
    assert owner_of(session, run) is None
    submitted(session, "a", "robots", 1)
    later = submitted(session, "b", "lab", 2)
    assert known(owner_of(session, run)) == ("robots", "key robots")
    assert known(record_owner(session, run, later)) == ("lab", "key lab")
    run.create({"run": "r", "queue": "other"})
    assert known(owner_of(session, run)) == ("lab", "key lab")  # the database's record comes first


def test_a_recreated_run_of_an_old_name_belongs_to_its_new_creator(session: Session, run: Run) -> None:
    first = submitted(session, "a", "robots", 1)
    record_owner(session, run, first)
    run.create({"run": "r", "queue": "robots"})
    first.status = "SUCCEEDED"
    session.commit()
    shutil.rmtree(run.path)
    assert owner_of(session, run) is None, "no caller is refused a run that does not exist"
    second = submitted(session, "b", "lab", 2)
    assert known(owner_of(session, run)) == ("lab", "key lab"), "before it has started, too"
    record_owner(session, run, second)
    run.create({"run": "r", "queue": "lab"})
    session.rollback()  # as where the controller is killed before it records the attempt
    assert known(owner_of(session, run)) == ("lab", "key lab")


def test_a_run_keeps_its_owner_while_the_volume_of_the_store_is_away(session: Session, run: Run) -> None:
    first = submitted(session, "a", "robots", 1)
    record_owner(session, run, first)
    run.create({"run": "r", "queue": "robots"})
    first.status = "SUCCEEDED"
    store = run.path.parent.parent
    store.rename(store.with_name("away"))
    later = submitted(session, "b", "lab", 2)
    assert known(owner_of(session, run)) == known(record_owner(session, run, later)) == ("robots", "key robots")


def test_an_existing_run_keeps_its_owner_whichever_job_continues_it(session: Session, run: Run) -> None:
    run.create({"run": "r", "queue": "robots", "owner": "key x"})
    later = submitted(session, "a", "lab", 1)
    assert known(record_owner(session, run, later)) == ("robots", "key x")


@pytest.mark.parametrize("content", [b"{}", b"damaged", b'{"queue": 7}', b"[" * 100_000])
def test_a_run_without_a_queue_exists_and_has_no_owner(session: Session, run: Run, content: bytes) -> None:
    run.path.mkdir()
    (run.path / "run.json").write_bytes(content)
    assert known(owner_of(session, run)) == ("", None)
    assert known(record_owner(session, run, submitted(session, "a", "lab", 1))) == ("lab", "key lab")
