"""Writes to the database: one at a time, so that what was checked still holds at the commit, and refused while they can't be kept.

A commit costs a trip to the disk, whatever it holds: submissions that arrive during one are written together by the next.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any, TypeVar

from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from orchestrator.control.disk import Disk
from orchestrator.control.isolation import Isolation
from orchestrator.control.store_identity import StoreAbsent
from orchestrator.domain.errors import RequestError
from orchestrator.persistence.session import Database, DatabaseError, DatabaseFull

T = TypeVar("T")
_Call = tuple[Callable[[Session], Any], Future[Any]]


class _OneIsToBlame(Exception):
    """One of several calls broke the group."""


class Writes:
    """Of one database. Any thread may call."""

    def __init__(self, database: Database, isolation: Isolation, disk: Disk) -> None:
        self._database, self._isolation, self._disk = database, isolation, disk
        self.lock = threading.Lock()
        """Held while something is registered, submitted or changed."""
        self._pending = deque[_Call]()

    def check(self, *, adds: bool) -> None:
        """Whether a request may change the database, to which it ``adds`` something or not.

        Raises:
            StoreAbsent: For an addition while the store is not there.
            DatabaseError: While the database can't be used, or is another controller's.
            DatabaseFull: For an addition while its volume has too little room.
        """
        if (trouble := self._isolation.trouble) is not None and (adds or not self._isolation.is_full):
            raise DatabaseError(trouble)
        if adds and (absent := self._disk.absent("store")):
            raise StoreAbsent(absent)
        if adds and (shortage := self._disk.shortage("database")):
            raise DatabaseFull(f"{shortage}, and nothing new is accepted")

    @contextmanager
    def session(self) -> Iterator[Session]:
        """A session whose changes are committed at the end of the block."""
        with self.lock, self._database.session() as session:
            yield session

    def gather(self, body: Callable[[Session], T]) -> T:
        """The result of ``body`` once it is committed, maybe with others'. Raises RequestError, or the database's error.

        Args:
            body: First looks, and raises RequestError where it refuses; then adds to the session.
        """
        future = Future[T]()
        self._pending.append((body, future))
        with self.lock:
            if not future.done():  # else the one that had the lock before has committed it
                self._commit([self._pending.popleft() for _ in range(len(self._pending))])
        return future.result()

    def _commit(self, calls: Sequence[_Call]) -> None:
        results = list[Any]()
        try:
            with self._database.session() as session:
                try:
                    for body, _ in calls:
                        try:
                            results.append(body(session))
                        except RequestError as error:  # it leaves nothing in the session and does not affect the others
                            results.append(error)
                    session.flush()
                except Exception as error:
                    if len(calls) == 1 or isinstance(error, OperationalError):
                        raise
                    raise _OneIsToBlame from error
        except _OneIsToBlame:  # nothing was committed
            for call in calls:
                self._commit([call])
            return
        except Exception as error:  # of the commit too, after which the stored state is unknown
            refused = [each if isinstance(each, RequestError) else error for each in results]
            results = [*refused, *[error] * (len(calls) - len(refused))]
        for (_, future), result in zip(calls, results, strict=True):
            if isinstance(result, Exception):
                future.set_exception(result)
            else:
                future.set_result(result)
