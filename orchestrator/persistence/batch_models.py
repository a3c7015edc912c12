"""The models of what AWS Batch has, too, as tables: definitions, queues, compute environments, policies, jobs, attempts, runs.

Times are Unix milliseconds, as in the Batch API. A change here needs a migration (``orchestrator/persistence/migrations``); a test compares.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, Self, TypeVar, overload

from sqlalchemy import JSON, BigInteger, ForeignKey, ForeignKeyConstraint, Index, String, UniqueConstraint, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship, validates

from orchestrator import machine
from orchestrator.domain.attempt import NOT_STARTED
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.hosts import Placement
from orchestrator.domain.job import AWS_CHILD_FAILED, AWS_ENDINGS, RunTime, Status, check_transition
from orchestrator.domain.reasons import Reason
from orchestrator.persistence.columns import Names, bounded, written_out
from orchestrator.persistence.gangs import gangs


def now() -> int:
    """Unix time [ms], the unit of every time in the database and in the Batch API."""
    return int(machine.wall() * 1000)


_T = TypeVar("_T")
_JSON_OR_NULL = JSON(none_as_null=True)


class Base(DeclarativeBase):
    type_annotation_map = {
        dict[str, Any]: JSON,
        dict[str, str]: JSON,
        list[dict[str, Any]]: JSON,
        list[str]: JSON,
        int: BigInteger,
    }


class JobDefinition(Base):
    """A registered job definition; a revision is never changed, only deregistered."""

    __tablename__ = "job_definitions"
    name: Mapped[str] = mapped_column(primary_key=True)
    revision: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    document: Mapped[dict[str, Any]]
    """The request as registered."""
    owner: Mapped[str | None] = mapped_column(default=None)
    """Whose key registered it."""
    status: Mapped[str] = mapped_column(default="ACTIVE")
    tags: Mapped[dict[str, str]] = mapped_column(default=dict)
    created_at: Mapped[int] = mapped_column(default=now)


class JobQueue(Base):
    """A job queue."""

    __tablename__ = "job_queues"
    name: Mapped[str] = mapped_column(primary_key=True)
    state: Mapped[str] = mapped_column(default="ENABLED")
    """``ENABLED``; ``DISABLED`` takes no new job and finishes those that it has."""
    priority: Mapped[int] = mapped_column(default=1)
    """The highest is served first."""
    compute_environments: Mapped[list[str]]
    """Their names, in the order in which they are tried."""
    sent_order: Mapped[list[dict[str, Any]] | None] = mapped_column(_JSON_OR_NULL, default=None)
    """``computeEnvironmentOrder`` as it was sent, with names; None: 1, 2, … in the order above."""
    policy: Mapped[str | None] = mapped_column(default=None)
    """Name of its scheduling policy; None: first in, first out."""
    limits: Mapped[list[dict[str, Any]]] = mapped_column(default=list)
    """``jobStateTimeLimitActions``."""
    deleting: Mapped[bool] = mapped_column(default=False)
    """Deleted by a person; gone once its last job is over."""
    tags: Mapped[dict[str, str]] = mapped_column(default=dict)
    created_at: Mapped[int] = mapped_column(default=now)


class ComputeEnvironment(Base):
    """Hosts of an engine, by a name."""

    __tablename__ = "compute_environments"
    name: Mapped[str] = mapped_column(primary_key=True)
    state: Mapped[str] = mapped_column(default="ENABLED")
    document: Mapped[dict[str, Any]]
    """The request that created it, with later updates applied."""
    tags: Mapped[dict[str, str]] = mapped_column(default=dict)
    created_at: Mapped[int] = mapped_column(default=now)


class SchedulingPolicy(Base):
    """A rule by which a queue's capacity is shared."""

    __tablename__ = "scheduling_policies"
    name: Mapped[str] = mapped_column(primary_key=True)
    fairshare: Mapped[dict[str, Any]]
    """``fairsharePolicy`` of the request."""
    tags: Mapped[dict[str, str]] = mapped_column(default=dict)
    created_at: Mapped[int] = mapped_column(default=now)


class _OfArray(Generic[_T]):
    """A value shared by the children of an array: stored once, with the array."""

    def __init__(self, own: str) -> None:
        """``own``: the column that holds it; NULL in a child."""
        self._own = own

    @overload
    def __get__(self, job: None, owner: type[Job]) -> Self: ...
    @overload
    def __get__(self, job: Job, owner: type[Job]) -> _T: ...
    def __get__(self, job: Job | None, owner: type[Job]) -> _T | Self:
        if job is None:  # so SQLAlchemy looks at a class
            return self
        holder = job if job.array is None else job.array
        value: _T = getattr(holder, self._own)
        return value

    def __set__(self, job: Job, value: _T) -> None:
        setattr(job, self._own, value)


_CHILDREN = text("parent IS NOT NULL")


def _listed(name: str, *columns: str, searched: Sequence[str] = ()) -> Index:
    """An index with a part of the list of jobs, which has no children of arrays, in its order. A search in it reads no row."""
    within = text("parent IS NULL")  # and the column itself, since SQLite looks at it in spite of that
    of_all = (*columns, "created_at", "id", *searched, "parent")
    return Index(name, *of_all, sqlite_where=within, postgresql_where=within)


class Job(Base):
    """A submitted job: a multi-node job, a single-node one, an array of such, or one child of an array."""

    __tablename__ = "jobs"
    __table_args__ = (
        UniqueConstraint("idempotency_key", name="uq_jobs_idempotency_key"),
        Index("ix_jobs_queue_status", "queue", "status", "created_at", "id"),
        Index("ix_jobs_parent", "parent", sqlite_where=_CHILDREN, postgresql_where=_CHILDREN),
        _listed("ix_jobs_list", searched=("queue", "name", "run", "owner")),
        _listed("ix_jobs_list_queue", "queue"),
        _listed("ix_jobs_list_status", "status"),
        _listed("ix_jobs_list_kind", "queue", "status"),
        Index("ix_jobs_ended", "stopped_at", "from_yaml", "queue", "id"),
    )
    id: Mapped[str] = mapped_column(primary_key=True)
    """A UUID; of an array's child ``<parent>:<index>``."""
    name: Mapped[str]
    queue: Mapped[str]
    owner: Mapped[str | None] = mapped_column(default=None)
    """The submitter: the name of a key, of a user, or MUSTER_TOKEN."""
    definition: Mapped[str] = mapped_column(index=True)
    """ARN with revision."""
    from_yaml: Mapped[bool] = mapped_column(default=False)
    """Whether it has a spec, from job YAML; else it came through the Batch API alone."""
    kind: Mapped[str] = mapped_column(default="multinode")
    """``multinode``, ``container`` (one node) or ``array`` (the parent of its children, with no process of its own)."""
    request: Mapped[dict[str, Any]]
    """SubmitJob as it came; of a request of the native API its digest; empty for an array's child."""
    own_node_properties: Mapped[dict[str, Any] | None] = mapped_column("node_properties", _JSON_OR_NULL)
    node_properties = _OfArray[dict[str, Any]]("own_node_properties")
    """Of the definition, with overrides and parameters applied; a ``container`` job is a gang of one node here."""
    run: Mapped[str] = mapped_column(index=True)
    status: Mapped[str] = mapped_column(default=Status.SUBMITTED, active_history=True)
    status_reason: Mapped[str | None] = mapped_column(default=None)
    created_at: Mapped[int] = mapped_column(default=now, index=True)
    runnable_at: Mapped[int | None] = mapped_column(default=None)
    """Since when it waits for resources."""
    queued_since: Mapped[int | None] = mapped_column(default=None)
    """When it was created, in steady time [ms] (:mod:`orchestrator.control.clock`): by this jobs are ordered."""
    started_at: Mapped[int | None] = mapped_column(default=None)
    stopped_at: Mapped[int | None] = mapped_column(default=None)
    attempts_allowed: Mapped[int] = mapped_column(default=1)
    own_evaluate_on_exit: Mapped[list[dict[str, Any]] | None] = mapped_column(
        "evaluate_on_exit", _JSON_OR_NULL, default=list
    )
    evaluate_on_exit = _OfArray[list[dict[str, Any]]]("own_evaluate_on_exit")
    timeout: Mapped[int | None] = mapped_column(default=None)
    """Seconds of each attempt."""
    stop_reason: Mapped[str | None] = mapped_column(default=None)
    """Set once the job was asked to end."""
    cancelled: Mapped[bool] = mapped_column(default=False)
    """Ended by CancelJob, or by the queue; else, with a stop reason, by TerminateJob."""
    first_epoch: Mapped[int | None] = mapped_column(default=None)
    share: Mapped[str | None] = mapped_column(default=None)
    priority: Mapped[int] = mapped_column(default=0)
    """Within its share; greater is served first."""
    own_parameters: Mapped[dict[str, str] | None] = mapped_column("parameters", _JSON_OR_NULL, default=dict)
    parameters = _OfArray[dict[str, str]]("own_parameters")
    own_tags: Mapped[dict[str, str] | None] = mapped_column("tags", _JSON_OR_NULL, default=dict)
    tags = _OfArray[dict[str, str]]("own_tags")
    parent: Mapped[str | None] = mapped_column(default=None)
    array_index: Mapped[int | None] = mapped_column(default=None)
    array_size: Mapped[int | None] = mapped_column(default=None)
    """Of the array that it is, or belongs to."""
    idempotency_key: Mapped[str | None] = mapped_column(default=None)
    attempts: Mapped[list[Attempt]] = relationship(
        back_populates="job", order_by="Attempt.number", cascade="all, delete-orphan"
    )
    dependencies: Mapped[list[Dependency]] = relationship(
        foreign_keys="Dependency.job_id", order_by="Dependency.on_id", cascade="all, delete-orphan"
    )

    array: Mapped[Job | None] = relationship(
        primaryjoin="foreign(Job.parent) == remote(Job.id)", viewonly=True, lazy="selectin", join_depth=1
    )
    """The array that it is a child of."""

    _bounded = validates("status_reason", "stop_reason")(bounded)

    @property
    def gang(self) -> GangSpec:
        """Commands and resources, from its definition; read once for an array. Raises ValueError if the definition is damaged."""
        properties, known = self.node_properties, self.__dict__.get("_gang")
        if known is None or known[0] is not properties:
            known = self.__dict__["_gang"] = properties, gangs.of((self.array or self).id, properties)
        gang: GangSpec = known[1]
        return gang

    @property
    def open_attempt(self) -> Attempt | None:
        """The attempt whose gang exists or may exist."""
        return next((attempt for attempt in self.attempts if attempt.stopped_at is None), None)

    @property
    def run_time(self) -> RunTime | None:
        """How long it has run; of an array, from the start of its first child to its end. None before it starts."""
        spans = [(each.started_at, each.stopped_at) for each in self.attempts]
        return RunTime.of([(self.started_at, self.stopped_at)] if self.kind == "array" else spans, now())

    @property
    def reason(self) -> Reason:
        """Why it is in its state, except for what the scheduler states about a job that waits."""
        text = self.status_reason or ""
        if AWS_ENDINGS.search(text) and self.attempts:
            return Reason(self.attempts[-1].in_own_words(text), text)
        of_children = self.kind == "array" and self.status == Status.FAILED and self.stop_reason is None
        return Reason(text, AWS_CHILD_FAILED if of_children else text)

    @property
    def is_terminal(self) -> bool:
        return Status(self.status).is_terminal

    def move(self, status: Status, reason: str | None = None) -> None:
        """Change the state; the reason stands until it is replaced. Raises ValueError for an illegal transition."""
        check_transition(Status(self.status), status)
        self.status = status
        if status == Status.RUNNABLE:
            self.runnable_at = now()
        if status.is_terminal:
            self.stopped_at = max(now(), self.started_at or 0)  # the clock may have been put back
        if reason is not None:
            self.status_reason = reason


_alone = Job.parent.is_(None)
Index("ix_jobs_named", Job.name, Job.created_at, sqlite_where=_alone, postgresql_where=_alone)
Index("ix_jobs_owned", Job.name, Job.owner, Job.created_at, sqlite_where=_alone, postgresql_where=_alone)


class RunRecord(Base):
    """The owner of a run. The run itself is in the store."""

    __tablename__ = "runs"
    name: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str | None] = mapped_column(default=None)
    """The submitter of the job that created it; None where unknown."""
    queue: Mapped[str]
    """Of that job: keys of this queue may read and continue the run."""
    created_at: Mapped[int] = mapped_column(default=now)


class Dependency(Base):
    """One job waits for the success of another."""

    __tablename__ = "dependencies"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    on_id: Mapped[str] = mapped_column(String, primary_key=True, index=True)
    """Id of the job on which it depends; kept when that job is deleted."""
    kind: Mapped[str | None] = mapped_column(default=None)
    """``N_TO_N`` or ``SEQUENTIAL`` as it was asked for; None: plain."""


class Attempt(Base):
    """One launch of a job's gang."""

    __tablename__ = "attempts"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    epoch: Mapped[int]
    compute_environment: Mapped[str | None] = mapped_column(default=None)
    """Its name, for :attr:`environment`."""
    handle: Mapped[str | None] = mapped_column(default=None)
    """The engine's name for the gang; None until it was launched."""
    ending: Mapped[str | None] = mapped_column(default=None)
    """An :class:`orchestrator.domain.job.Ending`, from the moment that the end was decided."""
    spent: Mapped[bool] = mapped_column(default=True)
    """Whether it counts against the job's attempts."""
    created_at: Mapped[int] = mapped_column(default=now)
    started_at: Mapped[int | None] = mapped_column(default=None)
    stopped_at: Mapped[int | None] = mapped_column(default=None)
    held_since: Mapped[int | None] = mapped_column(default=None)
    running_since: Mapped[int | None] = mapped_column(default=None)
    """``created_at`` and ``started_at`` in steady time [ms] (:mod:`orchestrator.control.clock`)."""
    status_reason: Mapped[str | None] = mapped_column(default=None)
    exit_code: Mapped[int | None] = mapped_column(default=None)
    fault: Mapped[str | None] = mapped_column(default=None)
    """As :attr:`orchestrator.domain.job.Verdict.fault`."""
    gpu_seconds: Mapped[float] = mapped_column(default=0.0)
    """GPUs times seconds held; set with ``cpu_seconds`` when the attempt is closed."""
    cpu_seconds: Mapped[float] = mapped_column(default=0.0)
    wasted_gpu_seconds: Mapped[float] = mapped_column(default=0.0)
    """GPU-seconds since the last checkpoint, for an attempt that failed: their work was lost."""
    wasted_cpu_seconds: Mapped[float] = mapped_column(default=0.0)
    nodes: Mapped[list[Node]] = relationship(order_by="Node.index", cascade="all, delete-orphan", lazy="selectin")
    """By index; none where the row was damaged."""
    job: Mapped[Job] = relationship(back_populates="attempts")

    _bounded = validates("status_reason")(bounded)
    _written_out = validates("fault")(written_out)

    @property
    def environment(self) -> str:
        """The name of its compute environment. Attempts of Muster 0.1 have none: they ran on this machine."""
        return self.compute_environment or "local"

    @property
    def run_time(self) -> RunTime | None:
        """How long it has run; None before it starts."""
        return RunTime.of([(self.started_at, self.stopped_at)], now())

    def in_own_words(self, reason: str) -> str:
        """The reason with the main node's own in place of AWS's general words, such as ``Essential container in task exited``."""
        try:
            main = self.node(self.job.gang.main)
        except ValueError:  # the job's row is damaged
            return reason
        if main is None or not main.reason:
            return reason
        own = main.reason if main.exit_code == 0 else f"{'main node: ' if self.handle else NOT_STARTED}{main.reason}"
        return AWS_ENDINGS.sub(lambda _: own, reason)

    def node(self, index: int) -> Node | None:
        """Its node of this index; None if it has none, because it was started with fewer nodes."""
        if index < len(self.nodes) and self.nodes[index].index == index:  # nearly always: they are in this order
            return self.nodes[index]
        return next((node for node in self.nodes if node.index == index), None)


class Node(Base):
    """One node of an attempt: its host, its resources, and its end."""

    __tablename__ = "nodes"
    __table_args__ = (ForeignKeyConstraint(["job_id", "attempt"], ["attempts.job_id", "attempts.number"]),)
    job_id: Mapped[str] = mapped_column(primary_key=True)
    attempt: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    """Its number."""
    index: Mapped[int] = mapped_column("node_index", primary_key=True, autoincrement=False)
    host: Mapped[str]
    gpus: Mapped[tuple[str, ...]] = mapped_column(Names, default=())
    """Ids of those that the scheduler gave it."""
    cpus: Mapped[float] = mapped_column(default=0.0)
    memory: Mapped[int] = mapped_column(default=0)
    """MiB."""
    address: Mapped[str | None] = mapped_column(default=None)
    """None before the engine was first asked; empty where it does not know."""
    devices: Mapped[tuple[str, ...] | None] = mapped_column(Names, default=None)
    """Ids of the GPUs that it has, from an engine that hands them out itself and tells."""
    exit_code: Mapped[int | None] = mapped_column(default=None)
    """None until it has ended."""
    reason: Mapped[str | None] = mapped_column(default=None)
    error: Mapped[str | None] = mapped_column(default=None)
    """Message of its first error."""
    stopped_at: Mapped[int | None] = mapped_column(default=None)
    status_reason: Mapped[str | None] = mapped_column(default=None)
    """AWS's status reason for a node that ended by itself."""
    met: Mapped[bool] = mapped_column(default=False)
    """Whether it has connected to the bus."""
    log_group: Mapped[str | None] = mapped_column(default=None, index=True)
    """Of its log stream; None: ``/aws/batch/job``; empty: the group was deleted."""
    log_prefix: Mapped[str | None] = mapped_column(default=None)
    """The stream's name begins with it; None: with the name of the job."""

    _written_out = validates("reason", "error", "status_reason")(written_out)

    @property
    def placement(self) -> Placement:
        return Placement(self.host, self.gpus, self.cpus, self.memory)

    def shown(self) -> dict[str, Any]:
        """Its part of the API's answer, as far as known."""
        allocated = {"index": self.index, "host": self.host, "gpus": list(self.gpus), "cpus": self.cpus}
        ended = {"exitCode": self.exit_code, "reason": self.reason, "error": self.error}
        known = {
            "address": self.address,
            "stoppedAt": self.stopped_at,
            "statusReason": self.status_reason,
            "met": self.met or None,
            "devices": None if self.devices is None else list(self.devices),
        }
        return {
            **allocated,
            "memory": self.memory,
            **{key: value for key, value in known.items() if value is not None},
            **(ended if self.exit_code is not None else {}),
        }
