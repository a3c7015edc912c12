"""Changes of many rows: one statement for each kind of change, and the same rows as without."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import event, select

from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.session import Database
from tests.support.orchestrator.rows import job

NAMES = [f"job-{number}" for number in range(5)]


@pytest.fixture
def database(database: Database) -> Database:
    with database.session() as session:
        for name in NAMES:
            row = job(name, status=Status.STARTING)
            nodes = [Node(index=index, host="h", cpus=1.0, memory=64) for index in range(2)]
            row.attempts.append(Attempt(number=1, epoch=0, nodes=nodes, compute_environment="fake"))
            session.add(row)
    return database


def updates(database: Database) -> tuple[list[tuple[str, int]], Any]:
    """The UPDATE statements from now on, each with the number of its rows; and what ends that."""
    found: list[tuple[str, int]] = []

    def note(_connection: Any, _cursor: Any, statement: str, parameters: Any, _context: Any, many: bool) -> None:
        if statement.startswith("UPDATE"):
            found.append((statement.partition(" WHERE")[0], len(parameters) if many else 1))

    event.listen(database.engine, "before_cursor_execute", note)
    return found, lambda: event.remove(database.engine, "before_cursor_execute", note)


def test_rows_that_change_alike_share_a_statement(database: Database) -> None:
    noted: list[str] = []
    database.committed = lambda jobs: noted.extend(each.id for each in jobs)
    found, done = updates(database)
    with database.session() as session, session.no_autoflush:
        for number, each in enumerate(session.scalars(select(Job).order_by(Job.id))):
            each.move(Status.RUNNING, f"runs {number}")
            each.attempts[0].running_since = number
            each.attempts[0].nodes[1].address = f"10.0.0.{number}"
            each.name = each.name  # the same value: nothing to write
    done()
    assert found == [
        ("UPDATE attempts SET running_since=?", 5),
        ("UPDATE jobs SET status=?, status_reason=?", 5),
        ("UPDATE nodes SET address=?", 5),
    ]
    assert noted == NAMES
    with database.session() as session:
        rows = session.scalars(select(Job).order_by(Job.id)).all()
        assert [(each.status, each.status_reason) for each in rows] == [
            (Status.RUNNING, f"runs {number}") for number in range(5)
        ]
        assert [each.attempts[0].running_since for each in rows] == list(range(5))
        assert [[node.address for node in each.attempts[0].nodes] for each in rows] == [
            [None, f"10.0.0.{number}"] for number in range(5)
        ]


def test_a_row_that_also_gets_children_is_written_once(database: Database) -> None:
    found, done = updates(database)
    with database.session() as session:
        one = session.get_one(Job, NAMES[0])
        one.move(Status.RUNNABLE, "again")
        one.attempts.append(Attempt(number=2, epoch=0, nodes=[], compute_environment="fake"))
    done()
    assert found == [("UPDATE jobs SET status=?, status_reason=?, runnable_at=?", 1)]
    with database.session() as session:
        assert [each.number for each in session.get_one(Job, NAMES[0]).attempts] == [1, 2]


def test_what_is_rolled_back_is_read_again_as_it_was(database: Database) -> None:
    with database.open() as session:
        one = session.get_one(Job, NAMES[0])
        one.move(Status.RUNNING, "runs")
        session.flush()
        session.rollback()
        assert (one.status, one.status_reason) == (Status.STARTING, None)
        one.move(Status.RUNNING, "runs after all")
        session.commit()
    with database.session() as session:
        assert session.get_one(Job, NAMES[0]).status_reason == "runs after all"
