"""The truth about jobs: tables and sessions (SQLAlchemy; SQLite by default)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, create_engine, event, select
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, relationship

from orchestrator.jobs import Status, check_transition


def now() -> int:
    """Unix time [ms], the unit of every time in the database and in the Batch API."""
    return int(time.time() * 1000)


class Base(DeclarativeBase):
    type_annotation_map = {dict[str, Any]: JSON, list[dict[str, Any]]: JSON, int: BigInteger}


class JobDefinition(Base):
    """A registered job definition; a revision is never changed."""

    __tablename__ = "job_definitions"
    name: Mapped[str] = mapped_column(primary_key=True)
    revision: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    document: Mapped[dict[str, Any]]
    """The request as registered."""
    status: Mapped[str] = mapped_column(default="ACTIVE")
    created_at: Mapped[int] = mapped_column(default=now)


class Job(Base):
    """A submitted job."""

    __tablename__ = "jobs"
    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(index=True)
    queue: Mapped[str] = mapped_column(index=True)
    definition: Mapped[str]
    """ARN with revision."""
    request: Mapped[dict[str, Any]]
    """SubmitJob as it came."""
    node_properties: Mapped[dict[str, Any]]
    """Of the definition, with the submission's overrides applied."""
    run: Mapped[str] = mapped_column(index=True)
    status: Mapped[str] = mapped_column(index=True, default=Status.SUBMITTED)
    status_reason: Mapped[str | None] = mapped_column(default=None)
    created_at: Mapped[int] = mapped_column(default=now, index=True)
    started_at: Mapped[int | None] = mapped_column(default=None)
    stopped_at: Mapped[int | None] = mapped_column(default=None)
    attempts_allowed: Mapped[int] = mapped_column(default=1)
    timeout: Mapped[int | None] = mapped_column(default=None)
    """Seconds of each attempt."""
    stop_reason: Mapped[str | None] = mapped_column(default=None)
    """Set when somebody asked the job to end."""
    first_epoch: Mapped[int | None] = mapped_column(default=None)
    attempts: Mapped[list[Attempt]] = relationship(
        back_populates="job", order_by="Attempt.number", cascade="all, delete-orphan"
    )

    @property
    def open_attempt(self) -> Attempt | None:
        """The attempt whose gang exists or may exist."""
        return next((attempt for attempt in self.attempts if attempt.stopped_at is None), None)

    def move(self, status: Status, reason: str | None = None) -> None:
        """Change the state; the reason stands until it is replaced. Raises ValueError for an illegal transition."""
        check_transition(Status(self.status), status)
        self.status = status
        if reason is not None:
            self.status_reason = reason[:1024]


class Attempt(Base):
    """One launch of a job's gang."""

    __tablename__ = "attempts"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    epoch: Mapped[int]
    handle: Mapped[str | None] = mapped_column(default=None)
    """The engine's name for the gang; None until it was launched."""
    ending: Mapped[str | None] = mapped_column(default=None)
    """An :class:`orchestrator.jobs.Ending`, from the moment that the end was decided."""
    spent: Mapped[bool] = mapped_column(default=True)
    """Whether it counts against the job's attempts."""
    created_at: Mapped[int] = mapped_column(default=now)
    started_at: Mapped[int | None] = mapped_column(default=None)
    stopped_at: Mapped[int | None] = mapped_column(default=None)
    status_reason: Mapped[str | None] = mapped_column(default=None)
    exit_code: Mapped[int | None] = mapped_column(default=None)
    nodes: Mapped[list[dict[str, Any]]]
    """By index: index, host, gpus, and, as they become known, address, exitCode, reason, error, and whether the bus met it."""
    job: Mapped[Job] = relationship(back_populates="attempts")


class Database:
    """Sessions on one database."""

    def __init__(self, url: str) -> None:
        """Open ``url`` (``sqlite:///path`` or any SQLAlchemy URL) and create the tables that are missing."""
        self.engine = create_engine(url)
        if self.engine.dialect.name == "sqlite":
            event.listen(self.engine, "connect", _tune_sqlite)
        Base.metadata.create_all(self.engine)

    @classmethod
    def at(cls, home: Path) -> Database:
        """The SQLite database of a Muster home directory."""
        return cls(f"sqlite:///{home / 'muster.db'}")

    @contextmanager
    def session(self) -> Iterator[Session]:
        """A session: committed at the end of the block (and wherever the block commits), rolled back on an exception."""
        with Session(self.engine, expire_on_commit=False) as session:
            yield session
            session.commit()

    def close(self) -> None:
        self.engine.dispose()


def _tune_sqlite(connection: Any, _record: object) -> None:
    cursor = connection.cursor()
    # WAL lets the API read while the controller writes; FULL makes a commit survive a power cut, as law 4 asks.
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=10000", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def find_job(session: Session, reference: str) -> Job | None:
    """The job with this id, else the newest one with this name, else the one whose id starts so (if it is the only one)."""
    job = session.get(Job, reference)
    if job:
        return job
    named = session.scalars(select(Job).where(Job.name == reference).order_by(Job.created_at.desc())).first()
    if named:
        return named
    if len(reference) < 4:
        return None
    prefixed = session.scalars(select(Job).where(Job.id.startswith(reference, autoescape=True)).limit(2)).all()
    return prefixed[0] if len(prefixed) == 1 else None
