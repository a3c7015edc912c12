"""The models of what a controller is and keeps: its clock, store, account, keys, secrets, texts, messages, log groups, uses of runs and queues.

Jobs are in :mod:`.batch_models`.
"""

from __future__ import annotations

from sqlalchemy import ForeignKey, Index
from sqlalchemy.orm import Mapped, mapped_column, relationship, validates

from orchestrator.persistence.batch_models import Base, Job, now
from orchestrator.persistence.columns import bounded


class ClockState(Base):
    """The one row of steady time (:mod:`orchestrator.control.clock`)."""

    __tablename__ = "clock"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    boot: Mapped[str]
    """Of the machine, as long as its monotonic clock counts on."""
    offset: Mapped[int]
    """Steady time less monotonic time [ms]."""
    drift: Mapped[int]
    """Wall-clock time less steady time [ms]."""


class KnownStore(Base):
    """The one row of the store that this database belongs to (:mod:`orchestrator.control.store_identity`)."""

    __tablename__ = "store"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    identity: Mapped[str]
    """As its ``store.json`` has it."""


class RunUse(Base):
    """A job needs another run than its own until it has ended: it reads it, or begins with its weights."""

    __tablename__ = "run_uses"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    run: Mapped[str] = mapped_column(primary_key=True, index=True)
    job: Mapped[Job] = relationship()
    """Never loaded: for it SQLAlchemy writes the job before this row, whatever their classes are called."""


class RetentionStart(Base):
    """The one row of a database that was older than retention (:mod:`orchestrator.domain.retention`)."""

    __tablename__ = "retention"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    since: Mapped[int]
    """When it was upgraded."""


class KeptText(Base):
    """A long text of jobs, which lies in the store (:mod:`orchestrator.control.kept_texts`)."""

    __tablename__ = "kept_texts"
    sha256: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str]
    """The one who has uploaded it last."""
    folder: Mapped[str]
    """That of the controller which keeps it."""
    size: Mapped[int]
    """Bytes."""
    uploaded_at: Mapped[int]
    used_at: Mapped[int]
    """When it was uploaded, or a definition or a job that names it was registered, last."""


class ShareUsage(Base):
    """A share's use of a queue, decayed to ``as_of`` (steady time [ms])."""

    __tablename__ = "share_usage"
    queue: Mapped[str] = mapped_column(primary_key=True)
    share: Mapped[str] = mapped_column(primary_key=True)
    seconds: Mapped[float]
    """GPU-seconds; CPU-seconds of jobs without GPUs."""
    as_of: Mapped[int]


class KnownAccount(Base):
    """The one row of the account in the ARNs (:mod:`orchestrator.control.account`)."""

    __tablename__ = "account"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    account: Mapped[str]
    region: Mapped[str]


class SealedSecret(Base):
    """A secret of the controller (:mod:`orchestrator.persistence.own_secrets`)."""

    __tablename__ = "sealed_secrets"
    name: Mapped[str] = mapped_column(primary_key=True)
    sealed: Mapped[str]


class AccessKey(Base):
    """A key of a caller (:mod:`orchestrator.persistence.access_keys`); a row never changes."""

    __tablename__ = "access_keys"
    name: Mapped[str] = mapped_column(primary_key=True)
    access_key_id: Mapped[str] = mapped_column(unique=True)
    sealed: Mapped[str]
    """Its secret."""
    queues: Mapped[list[str] | None]
    read_only: Mapped[bool]
    share: Mapped[str]
    created_at: Mapped[int]


class LogGroup(Base):
    """A log group of a user's own; ``/aws/batch/job``, which always exists, has a row once it has a setting or a tag."""

    __tablename__ = "log_groups"
    name: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str | None] = mapped_column(default=None)
    """Whose key created it, or submitted the first job that logs there."""
    retention: Mapped[int | None] = mapped_column(default=None)
    """``retentionInDays``, which is shown and deletes nothing."""
    tags: Mapped[dict[str, str]] = mapped_column(default=dict)
    created_at: Mapped[int] = mapped_column(default=now)


class LogStream(Base):
    """An empty stream that a client created; the streams of jobs are known by their nodes."""

    __tablename__ = "log_streams"
    log_group: Mapped[str] = mapped_column(ForeignKey("log_groups.name", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[int] = mapped_column(default=now)


class AutomaticEvaluation(Base):
    """Progress of a training's automatic evaluations (:mod:`orchestrator.services.automatic_evaluations`)."""

    __tablename__ = "automatic_evaluations"
    run: Mapped[str] = mapped_column(primary_key=True)
    training: Mapped[str]
    """Id of the job that trains, or trained last."""
    seen: Mapped[str]
    """Name of its newest checkpoint that was counted; empty before the first."""
    waiting: Mapped[int]
    """Checkpoints that were counted since the last evaluation was submitted."""
    passed: Mapped[int]
    """Checkpoints that were due and are not evaluated, since a newer one was."""
    checkpoint: Mapped[str | None] = mapped_column(default=None)
    job: Mapped[str | None] = mapped_column(default=None)
    """The last evaluation that was submitted: of which checkpoint, and the id of its job."""
    open: Mapped[bool] = mapped_column(default=False, index=True)
    """Whether that job waits or runs, so that retention keeps its checkpoint."""
    problem: Mapped[str | None] = mapped_column(default=None)
    """Why the evaluation that was due last could not be submitted."""

    _bounded = validates("problem")(bounded)


class WebhookDelivery(Base):
    """A message about a job that ended, until its receiver has accepted it (:mod:`orchestrator.control.deliveries`)."""

    __tablename__ = "webhook_deliveries"
    __table_args__ = (Index("ix_webhook_deliveries_due", "webhook", "next_at"),)
    id: Mapped[str] = mapped_column(primary_key=True)
    """Its ``webhook-id``."""
    webhook: Mapped[str]
    """Name of the webhook; its URL and its secret are not here."""
    job: Mapped[str] = mapped_column(index=True)
    created_at: Mapped[int] = mapped_column(default=now)
    next_at: Mapped[int | None]
    """When it is tried next; None where it was given up."""
    tries: Mapped[int] = mapped_column(default=0)
    body: Mapped[str | None] = mapped_column(default=None)
    """The message, unchanged from the first try on."""
    problem: Mapped[str | None] = mapped_column(default=None)
    """Error of the last try."""
