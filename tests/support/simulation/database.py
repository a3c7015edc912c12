"""A database in memory that fails, or ends its process, at any statement or commit."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from sqlalchemy import Dialect, Engine, StaticPool, create_engine, make_url
from sqlalchemy.orm import Session

from orchestrator.control.compute_environments import ensure_compute_environments
from orchestrator.persistence.batch_models import JobQueue
from orchestrator.persistence.job_counts import JobCounts
from orchestrator.persistence.session import Database, DatabaseError, _read_document
from tests.support.simulation.machine import LoopWaits

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation


class Memory(sqlite3.Connection):
    """The data, which outlives each process."""

    hook: Callable[[str], None] = staticmethod(lambda _: None)
    """Called with each statement, and with COMMIT and COMMITTED before and after a commit; raises where that fails."""

    def cursor(self, *_: Any) -> sqlite3.Cursor:  # type: ignore[override]
        return super().cursor(_Cursor)

    def close(self) -> None:
        """The data stay: SQLAlchemy closes the connection of a process that ends."""

    def commit(self) -> None:
        self.hook("COMMIT")
        super().commit()
        self.hook("COMMITTED")


class _Cursor(sqlite3.Cursor):
    def execute(self, statement: str, *parameters: Any) -> _Cursor:
        assert isinstance(self.connection, Memory)
        self.connection.hook(statement)
        super().execute(statement, *parameters)
        return self


@cache
def _template() -> sqlite3.Connection:
    """A database with all tables, and the queue of the simulated engine."""
    memory = sqlite3.connect(":memory:", check_same_thread=False)
    with TemporaryDirectory() as folder:
        database = Database.at(Path(folder))
        with database.session() as session:
            ensure_compute_environments(session, ["simulated"])
            session.add(JobQueue(name="urgent", priority=10, compute_environments=["simulated"]))
        database.close()
        file = sqlite3.connect(Path(folder) / "muster.db")
        file.backup(memory)
        file.close()
    return memory


@cache
def _dialect() -> Dialect:
    """Shared by all processes: what it has compiled serves the next one."""
    return create_engine("sqlite://", json_deserializer=_read_document).dialect


def new_memory() -> Memory:
    """An empty database."""
    memory = sqlite3.connect(":memory:", check_same_thread=False, factory=Memory)
    _template().backup(memory)
    return memory


class SimulatedDatabase(Database):
    """The sessions of one process of the controller."""

    def __init__(self, memory: Memory, world: Simulation) -> None:
        self._world, self._reserved = world, False
        self.committed = self.changed = self.ended = None
        self.counts = JobCounts()
        self._lock = self._file_lock = self._damage = self._file = self._identity = None
        memory.rollback()  # what a process that was killed has not committed

        def connection() -> Any:
            return memory

        self.engine = Engine(StaticPool(connection, dialect=_dialect()), _dialect(), make_url("sqlite://"))

    def reserve_connections(self) -> None:
        self._reserved = True

    def open(self) -> Session:
        if self._world.crowded and not (self._reserved and self._world.in_loop):
            if self._world.in_loop:
                raise LoopWaits
            raise DatabaseError("all connections are busy")
        return super().open()

    def close(self) -> None:
        """The data stay."""
