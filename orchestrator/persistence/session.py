"""The truth about jobs: sessions on a database (SQLAlchemy; SQLite by default, PostgreSQL by URL), and its migrations."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, cast

from sqlalchemy import (
    URL,
    Connection,
    Engine,
    Select,
    create_engine,
    event,
    inspect,
    make_url,
    text,
)
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import ORMExecuteState, Session

from orchestrator.domain.errors import Unavailable
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.job_counts import JobCounts, note_counts
from orchestrator.persistence.schema import BASE, NEWEST, UnknownSchema, bring_up_to_date, schema_of
from orchestrator.persistence.updates import write_changes
from orchestrator.persistence.urls import connect_args, database_url, is_in_memory, shown

_RESERVE = 5 << 20
"""Bytes; SQLite's write-ahead log has 4 MiB when it is copied into the file."""
_FULL = ("SQLITE_FULL", "SQLITE_IOERR_SHMSIZE")
_CONTROLLER_LOCK = 0x6D7573746572
"""Key of PostgreSQL's advisory lock: one controller a database."""
_POOL_TIMEOUT = 10.0
"""Seconds for which a request waits for a free connection."""

log = logging.getLogger("muster.controller")


class DatabaseError(Unavailable):
    """The database can't be used; the message says why and what to do."""


class DatabaseTaken(DatabaseError):
    """Another controller has the database."""


class DatabaseFull(DatabaseError):
    """The volume of the database has no room for additions; the ends of jobs are still written."""


class Database:
    """Sessions on one database; ``committed``, where set, is called with the jobs that a commit has changed."""

    _own: tuple[int, Engine] | None = None
    """A thread that has connections for itself alone, and the engine that makes them."""

    def __init__(self, url: str, *, beside: bool = False) -> None:
        """Open ``url`` (``sqlite:///path``, ``postgresql+psycopg://…``) and bring its tables up to date.

        ``beside``: another process, which may be a controller, has it already: this one takes no lock and changes no table's shape.

        Raises:
            DatabaseTaken: Another controller has it.
            DatabaseError: It can't be reached, is of another Muster's shape, or is not there yet.
        """
        self.is_beside = beside
        self.committed: Callable[[Sequence[Job]], None] | None = None
        self.changed: Callable[[Collection[str]], None] | None = None
        """Called with the ids of jobs that a commit has changed without loading them (:func:`note_changed`)."""
        self.ended: Callable[[Session, Job], None] | None = None
        """Called with each job that a transaction ends, before it is written: what it adds to the session is committed with that."""
        self.counts = JobCounts()
        """Of its jobs, once they are loaded."""
        self._lock: Connection | None = None
        self._file_lock: IO[bytes] | None = None
        self._damage: str | None = None
        """Message about the first damaged page that was met; None before."""
        self._file: Path | None = None
        self._identity: tuple[int, int] | None = None
        """Device and inode of the file, once it is open."""
        try:
            self.engine = self._new_engine(url)
        except (SQLAlchemyError, ModuleNotFoundError) as error:
            raise DatabaseError(_explain(shown(url), error)) from None
        try:
            self._open()
        except BaseException as error:
            self.close()
            if isinstance(error, SQLAlchemyError):
                raise DatabaseError(_explain(shown(url), error)) from None
            raise

    def _open(self) -> None:
        """Take the lock, then migrate: nothing of a database that another controller has is touched."""
        if self.engine.dialect.name == "sqlite" and not is_in_memory(self.engine.url):
            self._file = Path(str(self.engine.url.database))
        if self.is_beside:
            self._check_shape()
        elif self._file is not None:
            self._file_lock = self._take_file_lock(self._file)
            _make_private(self._file)
        elif self.engine.dialect.name != "sqlite":
            self._lock = self._take_lock()
        if not self.is_beside:
            self._migrate()
        if self._file is not None:
            found = self._file.stat()
            self._identity = found.st_dev, found.st_ino
            if not self.is_beside:
                self._reserve()

    def _new_engine(self, url: str | URL) -> Engine:
        parsed = make_url(url)
        is_sqlite = parsed.get_backend_name() == "sqlite"
        engine = create_engine(
            parsed,
            pool_pre_ping=not is_sqlite,
            connect_args=connect_args(parsed),
            json_deserializer=_read_document,
            **({} if is_in_memory(parsed) else {"pool_timeout": _POOL_TIMEOUT}),
        )
        if is_sqlite:
            # SQLite would make a new, empty file in place of one that was deleted
            event.listen(engine, "do_connect", lambda *_: self.check())
            event.listen(engine, "connect", _tune_sqlite)
        return engine

    def reserve_connections(self) -> None:
        """Give this thread connections for itself, which no other can take. A database in memory has only one."""
        if (self._own is None or self._own[0] != threading.get_ident()) and not is_in_memory(self.engine.url):
            self._own = threading.get_ident(), self._new_engine(self.engine.url)

    @classmethod
    def at(cls, home: Path, other: str | None = None, *, beside: bool = False) -> Database:
        """The database of a Muster home directory: its SQLite file, or the ``other`` that its controller uses, a URL or a path."""
        return cls(database_url(home, other), beside=beside)

    @contextmanager
    def session(self) -> Iterator[Session]:
        """A session: committed at the end of the block (and wherever the block commits), rolled back on an exception.

        Raises DatabaseError where the database can't be used, also after a commit into a file that is gone: what was written there
        must not be acknowledged.
        """
        with self.open() as session, self.using(session):
            yield session

    def open(self) -> Session:
        """A session for :meth:`using`; to be closed by the caller."""
        engine = self._own[1] if self._own and self._own[0] == threading.get_ident() else self.engine
        return _Session(engine, expire_on_commit=False, info={"database": self})

    @contextmanager
    def using(self, session: Session) -> Iterator[None]:
        """A block that uses an open session, as :meth:`session` says."""
        self.check()
        try:
            yield
            session.commit()
        except PoolTimeout as error:
            raise DatabaseError(
                f"database {self.shown}: all connections of this controller are busy; try again in a moment"
            ) from error
        except DBAPIError as error:
            if _is_damaged(error):
                self._damage = _explain(self.shown, error)
            elif not isinstance(error, OperationalError | InterfaceError):
                raise
            elif _is_full(error):
                raise DatabaseFull(f"database {self.shown}: its volume is full; make room there") from error
            raise DatabaseError(_explain(self.shown, error)) from error

    @property
    def volume(self) -> Path | None:
        """A directory on the volume that the database grows on; None where that is another machine's."""
        return self._file.absolute().parent if self._file is not None else None

    def check(self) -> None:
        """Make sure that the SQLite file is still the one that was opened, and not known to be damaged: two system calls.

        Raises DatabaseError where it is not, and from the first damaged page on: each write could make that worse.
        """
        if self._damage is not None:
            raise DatabaseError(self._damage)
        if self._file is None or self._identity is None:
            return
        try:
            found = self._file.stat()
        except FileNotFoundError:
            raise DatabaseError(
                f"database {self._file} was deleted while the controller runs; put that file back"
            ) from None
        except OSError as error:
            raise DatabaseError(f"database {self._file} can't be reached ({error.strerror})") from None
        if (found.st_dev, found.st_ino) != self._identity:
            raise DatabaseError(
                f"database {self._file} was replaced by another file while the controller runs; put the former one back, or "
                "restart the controller to use this one"
            )

    def keep_lock(self) -> None:
        """Make sure that this controller is still the database's only one (PostgreSQL forgets it with the connection).

        Raises DatabaseError where another has it by now, or the server can't be reached.
        """
        if self._lock is None:
            return
        try:
            self._lock.scalar(text("SELECT 1"))
        except SQLAlchemyError:
            self._lock.close()
            try:
                self._lock = self._take_lock()
            except SQLAlchemyError as error:
                raise DatabaseError(f"database {self.shown}: {_first_line(error)}") from error

    @property
    def shown(self) -> str:
        """Its URL, without the password."""
        return shown(str(self.engine.url))

    def _reserve(self) -> None:
        """Have SQLite own space that no other program on the volume can take: free pages in its file, and a write-ahead log as long as it
        grows between two checkpoints. With that a controller ends jobs, and records their ends, on a volume without a free byte.
        """
        try:
            with self.engine.connect() as connection:
                connection.exec_driver_sql("DROP TABLE IF EXISTS muster_reserve")
                connection.exec_driver_sql("CREATE TABLE muster_reserve (room BLOB)")
                connection.exec_driver_sql(f"INSERT INTO muster_reserve VALUES (zeroblob({_RESERVE}))")
                connection.commit()
                connection.exec_driver_sql("DROP TABLE muster_reserve")
                connection.commit()
                connection.exec_driver_sql("PRAGMA wal_checkpoint(PASSIVE)").close()
        except OperationalError as error:
            if not _is_full(error):
                raise
            log.warning("database %s: its volume is nearly full; make room there", self.shown)

    def close(self) -> None:
        if self._lock is not None:
            self._lock.close()
        self.engine.dispose()
        if self._own is not None:
            self._own[1].dispose()
        if self._file_lock is not None:
            self._file_lock.close()

    def _take_lock(self) -> Connection:
        """PostgreSQL drops it when the connection ends, however its process ends."""
        connection = self.engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        if not connection.scalar(text(f"SELECT pg_try_advisory_lock({_CONTROLLER_LOCK})")):
            connection.close()
            raise self._taken()
        return connection

    def _take_file_lock(self, path: Path) -> IO[bytes] | None:
        """The same for an SQLite file, beside it: its own locks are SQLite's. None where SQLite itself reports the problem."""
        try:
            file = open(f"{path.resolve()}.lock", "ab", opener=_private)  # noqa: SIM115 - held until close()
        except OSError:
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            if isinstance(error, BlockingIOError):
                raise self._taken() from None
            raise DatabaseError(f"database {self.shown}: {file.name} can't be locked ({error.strerror})") from None
        return file

    def _taken(self) -> DatabaseTaken:
        return DatabaseTaken(f"database {self.shown}: another controller has it; use that one, or stop it first")

    def _check_shape(self) -> None:
        """Raises DatabaseError unless a controller of this Muster's schema has made the tables."""
        if self._file is not None and not self._file.exists():
            raise DatabaseError(f"database {self.shown} is not there yet; try again once its controller has started")
        with self.engine.connect() as connection:
            if (found := schema_of(connection)) != NEWEST:
                raise DatabaseError(
                    f"database {self.shown} has schema {found or 'none'}, and this Muster needs {NEWEST}: its controller is another "
                    "version's; start that again with this version"
                )

    def _migrate(self) -> None:
        with self._unchecked() as connection:
            try:
                bring_up_to_date(connection)
            except UnknownSchema as error:
                where = f"database {self.shown}"
                if error.is_older:
                    raise DatabaseError(
                        f"{where} is from before schema {BASE}; lift it, in a clone of Muster, with: "
                        f"python -m docs.tools.lift_database {self._file or self.shown}"
                    ) from None
                raise DatabaseError(
                    f"{where} was written by a newer Muster (schema {error.revision}); install that version, or use another database"
                ) from None

    @contextmanager
    def _unchecked(self) -> Iterator[Connection]:
        """A transaction in which SQLite lets a table be replaced that others refer to (it can't alter one in place)."""
        with self.engine.connect() as connection:
            is_sqlite = self.engine.dialect.name == "sqlite"
            if is_sqlite:
                connection.exec_driver_sql("PRAGMA foreign_keys=OFF")
                connection.commit()
            with connection.begin():
                yield connection
            if is_sqlite:
                connection.exec_driver_sql("PRAGMA foreign_keys=ON")
                connection.commit()


def _make_private(path: Path) -> None:
    """Create an SQLite file for its user alone, or close one to others: the environments of jobs hold secrets."""
    with suppress(OSError):  # SQLite reports it in its own words
        os.close(_private(str(path), os.O_RDWR | os.O_CREAT))
    for name in (path.name, f"{path.name}-wal", f"{path.name}-shm"):  # SQLite gives new ones the mode of the first
        with suppress(OSError):
            path.with_name(name).chmod(0o600)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _is_damaged(error: Exception) -> bool:
    """Whether SQLite found that the file is not as it wrote it."""
    name = getattr(getattr(error, "orig", None), "sqlite_errorname", "")
    return str(name).startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB"))


def _explain(shown: str, error: Exception) -> str:
    """One line that names the database, the problem and the remedy."""
    if not _is_damaged(error):
        return f"database {shown}: {_first_line(error)}"
    path, found = shown.partition(":///")[2], getattr(error, "orig", error)
    return (
        f"database {shown} is damaged ({found}): stop the controller and put a backup in its place, or what "
        f"`sqlite3 {path} .recover` can still read"
    )


def _is_full(error: Exception) -> bool:
    """Whether SQLite or PostgreSQL found no room on its volume."""
    cause = getattr(error, "orig", None)
    return getattr(cause, "sqlite_errorname", "") in _FULL or getattr(cause, "sqlstate", "") == "53100"


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:500]


def _read_document(text: str) -> Any:
    """A JSON column. One that is damaged is empty, so that its row alone can't be used, and not the whole query's."""
    try:
        return json.loads(text)
    except ValueError:
        return {}


class _Session(Session):
    """A session that tells its database which jobs a commit has changed."""

    def commit(self) -> None:
        super().commit()
        self.info["database"].check()


@event.listens_for(_Session, "after_commit")
def _report_commit(session: Session) -> None:
    jobs, ids = session.info.pop("jobs", None), session.info.pop("ids", None)
    database = session.info["database"]
    database.counts.add(session.info.pop("counts", {}))
    if jobs and database.committed:
        database.committed([jobs[job_id] for job_id in sorted(jobs)])
    if ids and database.changed:
        database.changed(ids)


@event.listens_for(_Session, "after_rollback")
def _forget(session: Session) -> None:
    session.info.pop("jobs", None)
    session.info.pop("ids", None)
    session.info.pop("counts", None)


@event.listens_for(_Session, "do_orm_execute")
def _load_nodes(state: ORMExecuteState) -> None:
    """SQLite reads the whole table of nodes to find those of several attempts, by pairs of keys; by the jobs it uses the index."""
    is_of_nodes = state.is_relationship_load and state.bind_mapper is inspect(Node)
    pairs = state.parameters.get("primary_keys") if is_of_nodes and isinstance(state.parameters, dict) else None
    if pairs:  # else those of one attempt are loaded, by its key
        jobs = {job for job, _ in pairs}
        state.statement = cast(Select[Any], state.statement).where(Node.job_id.in_(jobs))


@event.listens_for(_Session, "before_flush")
def _write_changes(session: Session, _context: object, _instances: object) -> None:
    changed = list(session.dirty)
    if (ended := session.info["database"].ended) is not None:
        for each in changed:
            if isinstance(each, Job) and each.is_terminal and inspect(each).attrs.status.history.has_changes():
                ended(session, each)
    note_counts(session, changed)
    _note_jobs(session, write_changes(session, changed))


@event.listens_for(_Session, "after_flush")
def _note_flushed(session: Session, _context: object) -> None:
    _note_jobs(session, session.new)
    _note_jobs(session, session.dirty)


def _note_jobs(session: Session, changed: Iterable[object]) -> None:
    jobs = session.info.setdefault("jobs", {})
    for each in changed:
        if isinstance(each, Job):
            jobs[each.id] = each
        elif isinstance(each, Attempt) and each.job is not None:
            jobs[each.job.id] = each.job


def _tune_sqlite(connection: Any, _record: object) -> None:
    cursor = connection.cursor()
    # WAL lets the API read while the controller writes; FULL makes a commit survive a power cut, as law 4 asks.
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=10000", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
