"""The submission of a job: what is checked before it exists, and its rows: a job, or an array and its children."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, String, cast, insert, literal, select
from sqlalchemy.orm import Session

from orchestrator.control.compute_environments import queue_engines
from orchestrator.domain import reasons
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.gang_checks import CheckedGang
from orchestrator.domain.identifiers import SHARE
from orchestrator.domain.job import TERMINAL, WAITING, Status
from orchestrator.engines.secrets import SecretsError
from orchestrator.persistence import log_groups
from orchestrator.persistence.batch_models import Dependency, Job, JobDefinition, JobQueue, now
from orchestrator.persistence.gangs import gangs
from orchestrator.persistence.job_counts import ArrayRole, note_rows
from orchestrator.persistence.ownership import owner_of
from orchestrator.persistence.queries import note_changed
from orchestrator.services import permissions
from orchestrator.services.arns import definition_arn, job_arn
from orchestrator.services.context import Context, archived
from orchestrator.services.permissions import JobsOf, Operation
from orchestrator.services.sources import check_sources, hold_teacher, uses_of
from orchestrator.services.texts import check_texts
from orchestrator.spec.evaluations import evaluation_settings, place_of
from shared_store.volume.contents import is_archived
from shared_store.volume.layout import NAME

_KEY = re.compile(r"[\x21-\x7e]{1,128}")
_MOST_PRIORITY = 9999


@dataclass(frozen=True)
class Wait:
    """What a job waits for.

    Attributes:
        on: Id of another job; empty for the child before, of the array itself.
        kind: None for the whole job, ``N_TO_N`` for the child of the same index, ``SEQUENTIAL`` for the child before.
    """

    on: str
    kind: str | None = None


@dataclass(frozen=True)
class Submission:
    """A job to be submitted.

    Attributes:
        name: Of the job.
        queue: Its queue.
        definition: Its job definition.
        properties: Its node properties, with all overrides and parameters.
        gang: What these ask for.
        record: The request as it came, or :func:`record_of` it; kept with the job, and compared where its idempotency key comes again.
        share: From :func:`open_queue`.
        priority: Within its share.
        attempts: How often it may run.
        evaluate_on_exit: Conditions that retry or end it.
        timeout: Of an attempt [s].
        parameters: What stood for ``Ref::NAME`` in its commands.
        tags: Of the job.
        waits: What it waits for.
        array: Number of its children; None for a single job.
    """

    name: str
    queue: JobQueue
    definition: JobDefinition
    properties: Mapping[str, Any]
    gang: CheckedGang
    record: Mapping[str, Any]
    share: str | None = None
    priority: int = 0
    attempts: int = 1
    evaluate_on_exit: Sequence[Mapping[str, str]] = ()
    timeout: int | None = None
    parameters: Mapping[str, str] | None = None
    tags: Mapping[str, str] | None = None
    waits: Sequence[Wait] = ()
    array: int | None = None


class ShareRefused(ClientError):
    """A job can't have the share that it names; ``aws`` says so to a client of AWS's API."""

    def __init__(self, message: str, aws: str) -> None:
        super().__init__(message)
        self.aws = aws


def record_of(what: str, *parts: Any) -> dict[str, str]:
    """The record of a request of the native API: what it asked for, and the digest of its parts, which may be large."""
    return {what: hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}


def answered(context: Context, record: Mapping[str, Any]) -> Job | None:
    """The job that an earlier call with the same idempotency key has submitted.

    Raises ClientError (409) where that was another request than ``record``.
    """
    key = _scoped(context)
    job = context.session.scalars(select(Job).where(Job.idempotency_key == key)).first() if key else None
    if job is not None and job.request != record:
        raise ClientError(f"idempotency key {context.idempotency_key} was used for another request (job {job.id})", 409)
    return job


def answer(job: Job) -> dict[str, Any]:
    """What a submission answers: the job's ARN, name and id, as AWS names them."""
    return {"jobArn": job_arn(job.id), "jobName": job.name, "jobId": job.id}


def _scoped(context: Context) -> str | None:
    """The idempotency key as it is kept: two callers never share one."""
    key = context.idempotency_key
    if key is None:
        return None
    if not _KEY.fullmatch(key):
        raise ClientError("the idempotency key: 1 to 128 printable characters without spaces")
    return f"{context.actor.name}/{key}"


def open_queue(context: Context, queue: JobQueue, share: str | None, priority: int | None = None) -> str | None:
    """The share of a job in that queue: in one with a fair-share policy, the actor's, who may name no other.

    Raises ClientError where the actor may not submit there, ShareRefused where not with this share and priority.
    """
    context.actor.check(Operation.SUBMIT_JOB, JobsOf(queue.name))
    if queue.state != "ENABLED":
        raise ClientError(f"Job queue {queue.name} is DISABLED and takes no jobs")
    if queue.policy is None and (share is not None or priority is not None):
        raise ShareRefused(
            f"job queue {queue.name} has no fair-share policy, so its jobs have no share; leave the share out",
            # AWS's own words, with their missing space: clients match them
            "Job with shareIdentifier or schedulingPriority can onlybe submitted to job queue with fair share "
            "scheduling policy.",
        )
    if queue.policy is not None and (own := context.actor.share) is not None:
        if share not in (None, own):
            why = f"{share[:100]!r}: jobs of {context.actor.name} have its share, which is {own}: leave"
            raise ShareRefused(
                f"share {why} the share out, or use a key of that share",
                f"shareIdentifier {why} shareIdentifier (share in a YAML) out, or use a key of that share",
            )
        share = own
    if queue.policy is not None and not share:
        raise ShareRefused(
            f"job queue {queue.name} has a fair-share policy: give the job a share",
            f"Job queue {queue.name} has a fair share scheduling policy: give a shareIdentifier",
        )
    if share is not None and not re.fullmatch(rf"{SHARE}\*?", share):
        why = f"{share[:100]!r}: 1 to 255 letters and digits, a * at the end at most"
        raise ShareRefused(f"share {why}", f"shareIdentifier {why}")
    if priority is not None and not 0 <= priority <= _MOST_PRIORITY:
        raise ClientError(f"schedulingPriorityOverride is {priority}; it must be 0 to {_MOST_PRIORITY}")
    return share


def submit(context: Context, submitted: Submission) -> Job:
    """Submit a job; nothing is committed.

    Raises:
        ClientError: It can't be submitted as it is, or not by this actor.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
        TeacherNeeded: Its teacher's weights have to be copied first (:func:`.sources.with_teacher`).
    """
    gang = submitted.gang
    _check_commands(context, submitted)
    _check_secrets(context, submitted.queue, gang)
    log_groups.check_room(context.session, gang.log_groups, context.actor.name)
    job = _row(context, submitted)
    _check_automatic(context, submitted)
    check_texts(context, gang)
    teacher = check_sources(context, gang, bool(submitted.waits))
    job.idempotency_key = _scoped(context)
    if submitted.array is not None:
        _add_array(context, job, submitted.array, submitted.waits)
    else:
        job.dependencies.extend(Dependency(on_id=each.on, kind=each.kind) for each in submitted.waits)
        _release(job)
        if teacher:
            hold_teacher(context, job.run, teacher)
    context.session.add(job)
    context.session.add_all(uses_of(job.id, gang))
    log_groups.add_missing(context.session, gang.log_groups, job.owner)
    return job


def _row(context: Context, submitted: Submission) -> Job:
    copy = context.making or context.teacher
    job_id = copy.job if copy else str(uuid.uuid4())  # the same in each try: its run may have the copy already
    named = submitted.gang.options.run
    run = named or f"{submitted.name[:110]}-{job_id[:8]}"
    _check_run(context, run, bool(named))
    definition = submitted.definition
    job = Job(
        id=job_id,
        name=submitted.name,
        queue=submitted.queue.name,
        owner=context.actor.name,
        definition=definition_arn(definition.name, definition.revision),
        kind="array" if submitted.array is not None else definition.document["type"],
        request=submitted.record,
        node_properties=submitted.properties,
        from_yaml=submitted.gang.spec is not None,
        run=run,
        attempts_allowed=submitted.attempts,
        evaluate_on_exit=list(submitted.evaluate_on_exit),
        timeout=submitted.timeout,
        share=submitted.share,
        priority=submitted.priority,
        parameters=dict(submitted.parameters or {}),
        tags=dict(submitted.tags or {}),
        created_at=now(),
    )
    gangs.remember(job.id, submitted.properties, submitted.gang)
    return job


def _check_automatic(context: Context, submitted: Submission) -> None:
    """Raise ClientError where the actor could not submit the evaluations of this training."""
    evaluation = evaluation_settings(submitted.gang.spec)
    if evaluation is None:
        return
    place = place_of(submitted.queue.name, evaluation, submitted.share)
    try:
        open_queue(context, context.queue(place["queue"]), place.get("share"))
    except permissions.Refusal:
        raise
    except ClientError as error:
        raise ClientError(f"evaluation: {error}", error.status) from None


def _check_commands(context: Context, submitted: Submission) -> None:
    """A node without a command runs that of its image, where its engine runs images. Raises ClientError."""
    open_node = next((node for node in submitted.gang.nodes if not node.command), None)
    if open_node is None:
        return
    engine, queue, definition = context.controller.engines, submitted.queue.name, submitted.definition
    if without := engine.without_images(queue_engines(context.session, queue, engine.names[0])):
        where = f"job definition {definition.name}"
        if definition.document["type"] == "multinode":
            ranges = submitted.properties["nodeRangeProperties"]
            target = next(each["targetNodes"] for each in ranges if each["container"] is open_node.container)
            where = f"node range {target[:20]} of {where}"
        raise ClientError(
            f"{where} has no command, and engine {without[0]} of job queue {queue} runs no image, whose ENTRYPOINT "
            "and CMD could stand for one: give a command in the definition or in the overrides, or use a queue of an engine with images "
            "(docker, aws-batch)"
        )


def _check_secrets(context: Context, queue: JobQueue, gang: GangSpec) -> None:
    containers = [node.container for node in gang.nodes if node.container.get("secrets")]
    if containers:
        engines = queue_engines(context.session, queue.name, context.controller.engines.names[0])
        try:
            context.controller.engines.check_secrets(engines, containers, queue.name)
        except SecretsError as error:
            raise ClientError(str(error)) from None


def _check_run(context: Context, run: str, named: bool) -> None:
    """``named``: the caller chose the name.

    Raises ClientError where it can't be a run's, where the run is not the caller's, or where a job writes it now.
    """
    if not NAME.fullmatch(run):
        raise ClientError(f"MUSTER_RUN {run[:100]!r}: a run is named with letters, digits, '.', '_' and '-'")
    restricted = named and context.actor.queues is not None
    if restricted and (owner := owner_of(context.session, context.found(run))):
        context.actor.check(Operation.SUBMIT_JOB, owner)
    context.controller.access.users.check(run)
    if context.controller.access.beginning.get(run) not in (None, context.making, context.teacher):
        raise ClientError(f"run {run} is being begun by another request; try again when that has its answer", 503)
    holder = context.session.scalars(select(Job).where(Job.run == run, Job.status.not_in(TERMINAL)).limit(1)).first()
    if holder and not context.actor.may_see(holder):
        raise ClientError(f"run {run} is being written by another job; choose another name")
    if holder:
        raise ClientError(
            f"run {run} is being written by job {reasons.named(holder.name, holder.id)}; stop it first: muster stop {reasons.short_id(holder.id)}"
        )
    with contextlib.suppress(
        OSError, ValueError
    ):  # a store that is unavailable, or damaged: the job's own reason explains it
        target, version = context.run(run), context.controller.access.users.version(run)
        if not named:
            return
        writer, is_kept = context.read(
            ("writer", run, version), lambda: (context.controller.access.peers.writer(target), is_archived(target))
        )
        if writer:
            raise ClientError(f"run {run} is being written by {writer}; stop that job first")
        if is_kept:
            raise archived(run)


def _release(job: Job) -> None:
    """A job without dependencies becomes RUNNABLE in the commit that stores it: a second commit would cost as much again."""
    job.status = Status.SUBMITTED
    if not job.dependencies:
        job.move(Status.RUNNABLE, WAITING)


def _add_array(context: Context, parent: Job, size: int, waits: Sequence[Wait]) -> None:
    """The array and its children, jobs of their own by index; their common facts are stored with the array alone."""
    if parent.gang.options.run:
        raise ClientError("MUSTER_RUN is for one job; the children of an array have runs of their own")
    parent.array_size = size
    parent.dependencies.extend(Dependency(on_id=each.on, kind=each.kind) for each in waits if each.kind != "SEQUENTIAL")
    context.session.add(parent)
    context.session.flush()
    free = size if not waits else 1 if all(each.kind == "SEQUENTIAL" for each in waits) else 0
    # as the controller would set it at its first look, which then has nothing to write
    since = {"queued_since": parent.created_at - context.controller.clock.drift}
    ready = {**since, "status": Status.RUNNABLE, "status_reason": WAITING, "runnable_at": parent.created_at}
    _insert_children(context.session, parent, range(free), ready)
    _insert_children(context.session, parent, range(free, size), {**since, "status": Status.SUBMITTED})
    for each in waits:
        _insert_waits(context.session, parent, each, size)
    note_changed(context.session, (f"{parent.id}:{index}" for index in range(size)))


def _insert_children(session: Session, parent: Job, indices: range, state: Mapping[str, Any]) -> None:
    """The children of these indices, in one statement: ten thousand must not hold up other submissions."""
    if not indices:
        return
    index = _numbers(indices)
    copied = (
        "name",
        "queue",
        "owner",
        "definition",
        "from_yaml",
        "attempts_allowed",
        "timeout",
        "share",
        "priority",
        "array_size",
    )
    same = {
        **{name: getattr(parent, name) for name in copied},
        **{
            "kind": "container",
            "request": {},
            "parent": parent.id,
            "created_at": parent.created_at,
            "cancelled": False,
        },
        **state,
    }
    table = Job.metadata.tables["jobs"]
    values: dict[str, ColumnElement[Any]] = {
        **{name: literal(value, table.c[name].type) for name, value in same.items() if value is not None},
        "id": literal(f"{parent.id}:", String) + cast(index, String),
        "run": literal(f"{parent.run}-", String) + cast(index, String),
        "array_index": index,
    }
    session.execute(insert(table).from_select(list(values), select(*values.values()), include_defaults=False))
    note_rows(session, parent.queue, state["status"], ArrayRole.CHILD, len(indices))


def _insert_waits(session: Session, parent: Job, wait: Wait, size: int) -> None:
    """The dependencies of each child, from one entry of ``dependsOn``."""
    index = _numbers(range(1, size) if wait.kind == "SEQUENTIAL" else range(size))
    on: ColumnElement[Any] = literal(wait.on, String)
    if wait.kind == "N_TO_N":
        on = literal(f"{wait.on}:", String) + cast(index, String)
    elif wait.kind == "SEQUENTIAL":
        on = literal(f"{parent.id}:", String) + cast(index - 1, String)
    child = literal(f"{parent.id}:", String) + cast(index, String)
    rows = select(child, on, literal(wait.kind, String))
    session.execute(insert(Dependency).from_select(["job_id", "on_id", "kind"], rows))


def _numbers(numbers: range) -> ColumnElement[int]:
    """The column of a table that has these whole numbers as its rows."""
    first = select(literal(numbers.start, BigInteger).label("number")).cte("numbers", recursive=True)
    step = select(first.c.number + 1).where(first.c.number < numbers.stop - 1)
    column: ColumnElement[int] = first.union_all(step).c.number
    return column


def revision(
    context: Context,
    name: str,
    document: Mapping[str, Any],
    gang: GangSpec,
    tags: Mapping[str, str] | None = None,
    *,
    again: bool = True,
) -> JobDefinition:
    """A revision of a definition, to be added to the session.

    Args:
        name: Of the definition.
        document: The request of RegisterJobDefinition, without tags.
        gang: What the document asks for.
        tags: Of the definition.
        again: Whether a document that is the newest revision already becomes a revision of its own, as on AWS.

    Raises:
        ClientError: The store lacks a text that the document names.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
    """
    context.actor.check(Operation.REGISTER_JOB_DEFINITION)
    check_texts(context, gang)
    of_name = select(JobDefinition).where(JobDefinition.name == name).order_by(JobDefinition.revision.desc()).limit(1)
    if not again:
        own = context.session.scalars(of_name.where(JobDefinition.owner == context.actor.name)).first()
        if own and own.status == "ACTIVE" and own.document == document and own.tags == (tags or {}):
            return own
    newest = context.session.scalars(of_name).first()
    return JobDefinition(
        name=name,
        revision=newest.revision + 1 if newest else 1,
        document=dict(document),
        owner=context.actor.name,
        status="ACTIVE",
        tags=dict(tags or {}),
    )
