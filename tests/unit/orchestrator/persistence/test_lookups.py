"""A look-up of a job reads one row, however many jobs there are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import insert
from sqlalchemy.orm import Session

from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.queries import find_job, unknown_job
from orchestrator.persistence.session import Database
from tests.support.orchestrator.rows import job

ARRAY = "aaaaaaaa-0000-4000-8000-000000000000"


@pytest.fixture
def database(database: Database) -> Database:
    with database.session() as session:
        session.add(job(ARRAY, name="array", kind="array", array_size=10, created_at=5))
        session.add(job("bbbbbbbb-0000-4000-8000-000000000000", name="ant", created_at=5, queue="other"))
    return database


def fill(database: Database, count: int) -> None:
    """More jobs of one name in one queue, all with ids of one beginning; and as many children of one array."""
    shared = {
        "queue": "default",
        "definition": "arn:d:1",
        "request": {},
        "status": Status.SUCCEEDED,
        "kind": "container",
    }
    shared |= {"created_at": 1, "attempts_allowed": 1, "cancelled": False, "priority": 0}
    tops = [
        {**shared, "id": f"cccccccc-{number:08d}", "name": "ant", "run": "r", "parent": None} for number in range(count)
    ]
    ids = [f"{ARRAY}:{number}" for number in range(10, 10 + count)]
    children = [{**shared, "id": each, "name": "array", "run": "r", "parent": ARRAY} for each in ids]
    with database.session() as session:
        session.execute(insert(Job.__table__), [*tops, *children])  # type: ignore[arg-type]


LOOKS: dict[str, Callable[[Session], object]] = {
    "by id": lambda session: find_job(session, ARRAY),
    "by name": lambda session: find_job(session, "ant"),
    "by name in one queue": lambda session: find_job(session, "ant", ["other"]),
    "by name, of an owner": lambda session: find_job(session, "ant", None, "ann"),
    "by name, of an owner without one": lambda session: find_job(session, "ant", None, "eve"),
    "by the name of an array": lambda session: find_job(session, "array"),
    "by an unknown name": lambda session: find_job(session, "a name that is not there"),
    "by the beginning of an id": lambda session: find_job(session, "bbbb"),
    "by the beginning of an id in one queue": lambda session: find_job(session, "bbbb", ["other"]),
    "a child": lambda session: find_job(session, "array:12"),
    "what is not there": lambda session: unknown_job(session, "nosuch:3"),
}


@pytest.mark.parametrize("look", LOOKS)
def test_a_lookup_costs_the_same_with_many_jobs(database: Database, look: str) -> None:
    def steps() -> int:
        """Instructions of SQLite's machine."""
        count = 0

        def counted() -> int:
            nonlocal count
            count += 1
            return 0

        with database.session() as session:
            connection = session.connection().connection.dbapi_connection
            assert connection is not None
            connection.set_progress_handler(counted, 1)
            LOOKS[look](session)
            connection.set_progress_handler(None, 0)
        return count

    fill(database, 3)
    few = steps()
    with database.engine.begin() as connection:
        connection.exec_driver_sql("DELETE FROM jobs WHERE created_at = 1")
    fill(database, 3000)
    assert steps() <= 2 * few + 50


NAMED = {
    ("ant", "ann", None): "ann-new",
    ("ant", "bob", None): "bob",
    ("ant", "eve", None): "bob",
    ("ant", None, None): "bob",
    ("ant", "bob", ("lab",)): "ann-new",
    ("ant:3", "ann", None): "ann-new:3",
    ("ann-old", "bob", None): "ann-old",
}
"""By a reference, who asks, and the queues of who asks."""


@pytest.mark.parametrize("case", NAMED)
def test_a_name_is_ones_own_job_before_that_of_another(tmp_path: Path, case: tuple[str, str, tuple[str]]) -> None:
    database = Database.at(tmp_path)
    with database.session() as session:
        session.add(job("ann-old", name="ant", owner="ann", queue="lab", created_at=1))
        session.add(job("ann-new", name="ant", owner="ann", queue="lab", created_at=2, kind="array", array_size=4))
        session.add(job("bob", name="ant", owner="bob", queue="default", created_at=3))
        session.add(job("ann-new:3", name="ant", owner="ann", queue="lab", parent="ann-new", created_at=2))
    with database.session() as session:
        reference, owner, queues = case
        found = find_job(session, reference, queues, owner)
        assert found is not None and found.id == NAMED[case]
    database.close()
