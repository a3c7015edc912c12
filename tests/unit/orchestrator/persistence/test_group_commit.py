"""Submissions that come together: one commit, and each caller's own answer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select
from sqlalchemy.exc import IntegrityError, OperationalError
from sqlalchemy.orm import Session

from orchestrator.api.errors import ClientError
from orchestrator.persistence.group_commit import GroupCommit
from orchestrator.persistence.models import JobQueue
from orchestrator.persistence.session import Database


class Crowd:
    """Callers that all wait while somebody else writes, then are carried out together."""

    def __init__(self, home: Path) -> None:
        self.database, self.writing = Database.at(home), threading.Lock()
        self.together = GroupCommit(self.database, self.writing)
        self.commits = 0
        event.listen(self.database.engine, "commit", self._count)

    def _count(self, connection: Any) -> None:
        self.commits += 1

    def call(self, *bodies: Callable[[Session], dict[str, Any]]) -> list[Any]:
        """What each call answered or raised."""
        with ThreadPoolExecutor(len(bodies)) as threads:
            with self.writing:
                calls = [threads.submit(self.together.call, body) for body in bodies]
                while len(self.together._waiting) < len(bodies):
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
