"""Permissions: every operation of the API is decided here, for every kind of key and every object.

A key either writes or only reads (``--read-only``), and either has all queues or some (``--queue``). An object belongs to a queue
(a job; a run, to the queue of the job that created it; a model, to that of its run), to the key that made it (a job definition, a log group, a thing of a plug-in), or to all queues (a
queue itself, a compute environment, a scheduling policy).

================================  ===========================  ============================================================
object                            key with all queues          key with some queues
================================  ===========================  ============================================================
job, run of one of its queues     reads, writes                reads, writes
job, run of another queue         reads, writes                nothing; it is left out of lists
run of one of its queues          archives, deletes            archives and deletes its own
run of no known queue             reads, writes                nothing
job definition of its own         reads, writes, submits       reads, writes, submits
another's, tagged for its queue   reads, writes, submits       reads, submits
another's                         reads, writes, submits       reads, without the values of environment variables
thing of a plug-in                reads, writes                reads, creates its own; changes its own
log group                         reads, writes                reads, creates its own; changes its own
what all queues share             reads, writes                reads
================================  ===========================  ============================================================

A read-only key reads what the same key could read without ``--read-only``, without the values of environment variables, since
these hold secrets. The token in ``MUSTER_TOKEN`` and the controller's own user on loopback are keys with all queues.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from orchestrator.domain.errors import ClientError
from orchestrator.domain.reasons import named
from orchestrator.persistence.batch_models import (
    ComputeEnvironment,
    Job,
    JobDefinition,
    JobQueue,
    RunRecord,
    SchedulingPolicy,
)
from orchestrator.persistence.own_models import LogGroup

HIDDEN = "(hidden)"
"""Stands for the value of an environment variable that the caller may not read."""
QUEUES_TAG = "muster:queues"
"""Tag of a job definition: names of the queues, separated by spaces, whose keys may read it and submit with it; ``*`` for all."""


class Refusal(ClientError):
    """A refused request; ``kind`` is AWS's name of the reason."""

    def __init__(self, kind: str, message: str, status: int = 403) -> None:
        super().__init__(message, status)
        self.kind = kind


class Operation(StrEnum):
    """Every operation: AWS's by their names, the native ones by method and path."""

    REGISTER_JOB_DEFINITION = "RegisterJobDefinition"
    DESCRIBE_JOB_DEFINITIONS = "DescribeJobDefinitions"
    DEREGISTER_JOB_DEFINITION = "DeregisterJobDefinition"
    SUBMIT_JOB = "SubmitJob"
    DESCRIBE_JOBS = "DescribeJobs"
    LIST_JOBS = "ListJobs"
    TERMINATE_JOB = "TerminateJob"
    CANCEL_JOB = "CancelJob"
    TERMINATE_JOBS = "TerminateJobs"
    CANCEL_JOBS = "CancelJobs"
    CREATE_JOB_QUEUE = "CreateJobQueue"
    DESCRIBE_JOB_QUEUES = "DescribeJobQueues"
    UPDATE_JOB_QUEUE = "UpdateJobQueue"
    DELETE_JOB_QUEUE = "DeleteJobQueue"
    GET_JOB_QUEUE_SNAPSHOT = "GetJobQueueSnapshot"
    CREATE_COMPUTE_ENVIRONMENT = "CreateComputeEnvironment"
    DESCRIBE_COMPUTE_ENVIRONMENTS = "DescribeComputeEnvironments"
    UPDATE_COMPUTE_ENVIRONMENT = "UpdateComputeEnvironment"
    DELETE_COMPUTE_ENVIRONMENT = "DeleteComputeEnvironment"
    CREATE_SCHEDULING_POLICY = "CreateSchedulingPolicy"
    DESCRIBE_SCHEDULING_POLICIES = "DescribeSchedulingPolicies"
    LIST_SCHEDULING_POLICIES = "ListSchedulingPolicies"
    UPDATE_SCHEDULING_POLICY = "UpdateSchedulingPolicy"
    DELETE_SCHEDULING_POLICY = "DeleteSchedulingPolicy"
    TAG_RESOURCE = "TagResource"
    UNTAG_RESOURCE = "UntagResource"
    LIST_TAGS_FOR_RESOURCE = "ListTagsForResource"
    GET_LOG_EVENTS = "GetLogEvents"
    FILTER_LOG_EVENTS = "FilterLogEvents"
    DESCRIBE_LOG_STREAMS = "DescribeLogStreams"
    DESCRIBE_LOG_GROUPS = "DescribeLogGroups"
    CREATE_LOG_GROUP = "CreateLogGroup"
    DELETE_LOG_GROUP = "DeleteLogGroup"
    PUT_RETENTION_POLICY = "PutRetentionPolicy"
    DELETE_RETENTION_POLICY = "DeleteRetentionPolicy"
    CREATE_LOG_STREAM = "CreateLogStream"
    DELETE_LOG_STREAM = "DeleteLogStream"
    START_LIVE_TAIL = "StartLiveTail"
    READ_HEALTH = "GET /healthz"
    READ_DOCUMENTATION = "GET /api/docs"
    READ_MONITORING = "GET /metrics"
    READ_CAPACITY = "GET /api/capacity"
    READ_QUEUES = "GET /api/queues"
    PLAN = "POST /api/plan"
    FIT = "POST /api/fit"
    SUBMIT_SPEC = "POST /api/jobs"
    FIND_JOBS = "GET /api/jobs"
    READ_JOB = "GET /api/jobs/{reference}"
    READ_JOB_LOGS = "GET /api/jobs/{reference}/logs"
    CHECKPOINT_JOB = "POST /api/jobs/{reference}/checkpoint"
    READ_JOB_STACKS = "GET /api/jobs/{reference}/stacks"
    LIST_RUNS = "GET /api/runs"
    READ_RUN = "GET /api/runs/{name}"
    READ_CHECKPOINTS = "GET /api/runs/{name}/checkpoints"
    READ_METRICS = "GET /api/runs/{name}/metrics"
    READ_EVALUATIONS = "GET /api/runs/{name}/evaluations"
    RESUME_RUN = "POST /api/runs/{name}/resume"
    CLONE_RUN = "POST /api/runs/{name}/clone"
    REGISTER_MODEL = "POST /api/runs/{name}/models"
    ARCHIVE_RUN = "POST /api/runs/{name}/archive"
    DELETE_RUN = "DELETE /api/runs/{name}"
    READ_GARBAGE = "GET /api/gc"
    TAKE_GARBAGE = "POST /api/gc"
    LIST_MODELS = "GET /api/models"
    READ_MODEL = "GET /api/models/{name}"
    READ_KEYS = "GET /api/keys"
    CREATE_KEY = "POST /api/keys"
    DELETE_KEY = "DELETE /api/keys/{name}"
    KEEP_TEXT = "PUT /api/texts/{sha256}"
    READ_TEXT = "GET /api/runs/{name}/texts/{sha256}"
    READ_WEBHOOKS = "GET /api/webhooks"
    TEST_WEBHOOK = "POST /api/webhooks/{name}/test"

    @property
    def reads(self) -> bool:
        """Whether it changes nothing, so that a read-only key may send it."""
        return self.value.startswith(("GET ", "Describe", "List", "Get", "Filter", "StartLiveTail"))


class AddedOperation(str):
    """An operation of a plug-in: method and path of its route."""

    @property
    def reads(self) -> bool:
        """As :attr:`Operation.reads`."""
        return self.startswith("GET ")


_OF_THE_OWNER = frozenset({Operation.ARCHIVE_RUN, Operation.DELETE_RUN})
"""What a key with some queues may do to its own runs alone."""
BY_LOWER_NAME = {operation.lower(): operation for operation in Operation}


@dataclass(frozen=True)
class JobsOf:
    """The jobs of a queue as a whole: to submit there, to list them, to see their order."""

    queue: str


@dataclass(frozen=True)
class Owned:
    """Something of a plug-in: its owner and keys with all queues change it, all read it."""

    kind: str
    """In words, such as ``league``."""
    name: str
    owner: str


@dataclass(frozen=True)
class Shared:
    """Something of all queues that has no row yet."""


_OfQueues = Job | RunRecord | JobsOf | JobDefinition | Owned | LogGroup
Object = _OfQueues | JobQueue | ComputeEnvironment | SchedulingPolicy | Shared


@dataclass(frozen=True)
class Actor:
    """Who asks for something.

    Attributes:
        name: Of a key, such as ``key ann``, or of a user of this machine.
        queues: Names of the queues that it may use, and whose jobs and runs it may see; None means all.
        read_only: Whether it may change nothing.
        share: Share identifier of its jobs in queues with a fair-share policy; None where the jobs name theirs.
    """

    name: str
    queues: frozenset[str] | None = None
    read_only: bool = False
    share: str | None = None

    def check(self, operation: Operation | AddedOperation, *objects: Object) -> None:
        """Raise Refusal (403, AccessDeniedException) where the actor may not do this to all of these objects."""
        if self.read_only and not operation.reads:
            raise Refusal(
                "AccessDeniedException", f"{self.name} is read-only: {operation} is refused; use a key that may write"
            )
        for each in objects:
            if not _allowed(self, operation, each):
                if operation in _OF_THE_OWNER and _allowed(self, Operation.READ_RUN, each):
                    raise Refusal(
                        "AccessDeniedException", f"{self.name}: {operation} is refused, since {_made_by(each)}"
                    )
                raise self._refusal(operation, _owner_of(each))

    def check_all_queues(self, operation: Operation | AddedOperation) -> None:
        """Raise Refusal unless the actor may see all queues in one answer."""
        if self.queues is not None:
            raise self._refusal(operation, "it concerns all queues")

    def may_see(self, target: Object) -> bool:
        """Whether the actor may read all of it; lists leave out the rest."""
        return _allowed(self, Operation.LIST_JOBS, target)

    def shown(self, answer: Any) -> Any:
        """An answer as the actor may see it: to a read-only key without the values of environment variables."""
        return without_values(answer) if self.read_only else answer

    def _refusal(self, operation: Operation | AddedOperation, why: str) -> Refusal:
        queues = ", ".join(sorted(self.queues or ())) or "none"
        return Refusal(
            "AccessDeniedException",
            f"{self.name} is not authorized for {operation} (the key is limited to job queue {queues}): {why}",
        )


CONTROLLER = Actor("this process")
"""The controller itself, which may do everything."""


def without_values(document: Any) -> Any:
    """A copy of a JSON document in which every ``environment`` has its names, but not its values."""
    if isinstance(document, list | tuple):
        return [without_values(each) for each in document]
    if not isinstance(document, Mapping):
        return document
    return {key: _hidden(value) if key == "environment" else without_values(value) for key, value in document.items()}


def _hidden(environment: Any) -> Any:
    """The two forms of an environment: AWS's list of names and values, and the mapping of our YAML."""
    if isinstance(environment, Mapping):
        return dict.fromkeys(environment, HIDDEN)
    if isinstance(environment, list):
        return [{**each, "value": HIDDEN} if isinstance(each, Mapping) else HIDDEN for each in environment]
    return environment


def _allowed(actor: Actor, operation: Operation | AddedOperation, target: Object) -> bool:
    queues = actor.queues
    if queues is None:
        return True
    match target:
        case RunRecord() if operation in _OF_THE_OWNER:
            return target.queue in queues and target.owner == actor.name
        case Job() | RunRecord() | JobsOf():
            return target.queue in queues
        case Owned() | LogGroup():
            return target.owner == actor.name or operation.reads
        case JobDefinition():
            shared = target.tags.get(QUEUES_TAG, "").split()
            tagged = "*" in shared or not queues.isdisjoint(shared)
            return target.owner == actor.name or (tagged and (operation.reads or operation is Operation.SUBMIT_JOB))
        case _:
            return operation.reads


def _made_by(target: Object) -> str:
    owner = getattr(target, "owner", None) or "an unknown key"
    return f"run {getattr(target, 'name', '')} was made by {owner}; its owner may, and a key with all queues"


def _owner_of(target: Object) -> str:
    match target:
        case Job():
            return f"job {named(target.name, target.id)} belongs to job queue {target.queue}"
        case RunRecord():
            return (
                f"run {target.name} belongs to {f'job queue {target.queue}' if target.queue else 'no known job queue'}"
            )
        case JobsOf():
            return f"it concerns job queue {target.queue}"
        case Owned():
            return f"{target.kind} {target.name} was created by {target.owner}"
        case LogGroup():
            return f"log group {target.name[:200]} was created by {target.owner or 'the controller'}"
        case JobDefinition():
            return (
                f"job definition {target.name} was registered by {target.owner or 'an unknown key'}; register your own "
                f"revision, or have it tagged {QUEUES_TAG} with the names of the queues whose keys may submit it"
            )
        case _:
            return "it concerns other queues too"
