"""Writes to the database: one at a time, so that what was checked still holds at the commit, and refused while they can't be kept."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from sqlalchemy.orm import Session

from orchestrator.control.disk import Disk
from orchestrator.control.isolation import Isolation
from orchestrator.control.store_identity import StoreAbsent
from orchestrator.persistence.group_commit import GroupCommit
from orchestrator.persistence.session import Database, DatabaseError, DatabaseFull

T = TypeVar("T")


class Writes:
    """Of one database. Any thread may call."""

    def __init__(self, database: Database, isolation: Isolation, disk: Disk) -> None:
        self._database, self._isolation, self._disk = database, isolation, disk
        self.lock = threading.Lock()
        """Held while something is registered, submitted or changed."""
        self._gathered = GroupCommit(database, self.lock)

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
        """The result of ``body``, which adds to its session, once that is committed, maybe with others'. Raises what ``body`` raises."""
        return self._gathered.call(body)
