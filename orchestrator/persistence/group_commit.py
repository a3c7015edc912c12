"""Many submissions, one commit: submissions that arrive during a write to the disk are written together.

A commit costs a trip to the disk, whatever it holds. An uncontended submission commits at once.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from orchestrator.domain.errors import RequestError
from orchestrator.persistence.session import Database

T = TypeVar("T")
_NOTHING = object()


@dataclass(eq=False)
class _Call:
    body: Callable[[Session], Any]
    answer: Any = _NOTHING
    error: Exception | None = None


class _OneIsToBlame(Exception):
    """One of several calls broke the group."""


class GroupCommit:
    """Carries out calls that only add to the database. Any thread may call."""

    def __init__(self, database: Database, writing: threading.Lock) -> None:
        """``writing``: held during each write to the database."""
        self._database, self._writing = database, writing
        self._waiting: deque[_Call] = deque()

    def call(self, body: Callable[[Session], T]) -> T:
        """The answer of ``body``, once it is committed. Raises RequestError, or the database's error.

        Args:
            body: First looks, and raises RequestError where it refuses; then adds to the session.
        """
        mine = _Call(body)
        self._waiting.append(mine)
        with self._writing:
            if mine.answer is _NOTHING and mine.error is None:  # else the previous lock holder committed it
                calls = [self._waiting.popleft() for _ in range(len(self._waiting))]
                self._carry_out(calls)
        if mine.error is not None:
            raise mine.error
        answer: T = mine.answer
        return answer

    def _carry_out(self, calls: list[_Call]) -> None:
        try:
            with self._database.session() as session:
                try:
                    answers = [self._answer(session, call) for call in calls]
                    session.flush()
                except OperationalError:
                    raise
                except Exception as error:
                    if len(calls) == 1:
                        raise
                    raise _OneIsToBlame from error
        except _OneIsToBlame:  # nothing was committed
            for call in calls:
                call.error = None
                self._carry_out([call])
            return
        except Exception as error:  # of the commit too, after which the stored state is unknown
            for call in calls:
                call.error = call.error or error
            return
        for call, answer in zip(calls, answers, strict=True):
            call.answer = answer

    @staticmethod
    def _answer(session: Session, call: _Call) -> Any:
        """None if it is refused, which leaves nothing in the session and does not affect the others."""
        try:
            return call.body(session)
        except RequestError as error:
            call.error = error
            return None
