"""SubmitJob: multi-node jobs, single-node jobs, arrays of them, and their dependencies."""

from __future__ import annotations

import contextlib
import re
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, String, cast, insert, literal, select
from sqlalchemy.orm import Session

from orchestrator.api.arns import definition_arn, job_arn, split_reference
from orchestrator.api.batch import fargate, rules
from orchestrator.api.batch.members import check_consumables
from orchestrator.api.context import Context, archived
from orchestrator.api.kept_texts import check_texts
from orchestrator.api.sources import check_sources, hold_teacher, uses_of
from orchestrator.control.compute_environments import environments_of, queue_engines
from orchestrator.domain import reasons
from orchestrator.domain.errors import SpecError
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.job import TERMINAL, WAITING, Status
from orchestrator.engines.secrets import SecretsError
from orchestrator.persistence import log_groups
from orchestrator.persistence.gangs import gangs
from orchestrator.persistence.job_counts import Place, note_rows
from orchestrator.persistence.models import Dependency, Job, JobDefinition, JobQueue, now
from orchestrator.persistence.ownership import owner_of
from orchestrator.persistence.queries import note_changed
from orchestrator.services import permissions
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Actor, JobsOf, Operation
from orchestrator.spec.evaluations import place_of, wanted_of
from shared_store.volume.contents import is_archived
from shared_store.volume.layout import NAME

_MOST_DEPENDENCIES = 20
_ARRAY_SIZES = range(2, 10_001)
_KEY = re.compile(r"[\x21-\x7e]{1,128}")


def submit_job(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """SubmitJob. With an idempotency key a second call gets the answer of the first one."""
    request = {key: value for key, value in request.items() if value not in ({}, [])}  # Luigi sends what it has not set
    if (job := answered(context)) is not None:
        if job.request != request:
            raise ClientError(
                f"idempotency key {context.idempotency_key} was used for another request (job {job.id})", 409
            )
        return answer(job)
    rules.check_name("jobName", request["jobName"])
    rules.check_tries(request)
    rules.check_tags(request.get("tags") or {})
    queue = _queue(context, request)
    definition = context.definition(request["jobDefinition"])
    context.actor.check(Operation.SUBMIT_JOB, definition)
    job, gang = _job(context, request, queue, definition)
    _check_automatic(context, request, gang)
    is_array, is_waiting = bool(request.get("arrayProperties")), bool(request.get("dependsOn"))
    check_texts(context, gang)
    teacher = check_sources(context, gang, is_waiting)
    job.idempotency_key = _scoped(context.actor, context.idempotency_key)
    if is_array:
        _add_array(context, job, request)
    else:
        for dependency in _dependencies(context, request, None):
            job.dependencies.append(dependency)
        _release(job)
        if teacher:
            hold_teacher(context, job.run, teacher)
    context.session.add(job)
    context.session.add_all(uses_of(job.id, gang))
    log_groups.add_missing(context.session, gang.log_groups, job.owner)
    return answer(job)


def answered(context: Context) -> Job | None:
    """The job that an earlier call with the same idempotency key has submitted."""
    key = _scoped(context.actor, context.idempotency_key)
    return context.session.scalars(select(Job).where(Job.idempotency_key == key)).first() if key else None


def answer(job: Job) -> dict[str, Any]:
    return {"jobArn": job_arn(job.id), "jobName": job.name, "jobId": job.id}


def _scoped(actor: Actor, key: str | None) -> str | None:
    """Two callers never share a key."""
    if key is None:
        return None
    if not _KEY.fullmatch(key):
        raise ClientError("the idempotency key: 1 to 128 printable characters without spaces")
    return f"{actor.name}/{key}"


def _queue(context: Context, request: Mapping[str, Any]) -> JobQueue:
    queue = context.queue(request["jobQueue"])
    context.actor.check(Operation.SUBMIT_JOB, JobsOf(queue.name))
    if queue.state != "ENABLED":
        raise ClientError(f"Job queue {queue.name} is DISABLED and takes no jobs")
    share, priority = request.get("shareIdentifier"), request.get("schedulingPriorityOverride")
    if queue.policy is None and (share is not None or priority is not None):
        # AWS's own words, with their missing space: clients match them
        raise ClientError(
            "Job with shareIdentifier or schedulingPriority can onlybe submitted to job queue with fair share "
            "scheduling policy."
        )
    if queue.policy is not None and not share:
        raise ClientError(f"Job queue {queue.name} has a fair share scheduling policy: give a shareIdentifier")
    if share is not None and not re.fullmatch(r"[A-Za-z0-9]{1,255}\*?", share):
        raise ClientError(f"shareIdentifier {share[:100]!r}: 1 to 255 letters and digits, a * at the end at most")
    rules.check_priority("schedulingPriorityOverride", priority)
    return queue


def _check_automatic(context: Context, request: Mapping[str, Any], gang: GangSpec) -> None:
    """Raise ClientError where the caller could not submit the evaluations of this training."""
    try:
        wanted = wanted_of(gang.spec)
    except SpecError as error:
        raise ClientError(str(error)) from None
    if wanted is None:
        return
    place = place_of(request["jobQueue"], request.get("shareIdentifier"), wanted)
    asked = {"jobQueue": place["queue"], **({"shareIdentifier": place["share"]} if "share" in place else {})}
    try:
        _queue(context, asked)
    except permissions.Refusal:
        raise
    except ClientError as error:
        raise ClientError(f"evaluation: {error}", error.status) from None


def _job(context: Context, request: dict[str, Any], queue: JobQueue, definition: JobDefinition) -> tuple[Job, GangSpec]:
    document, name = definition.document, request["jobName"]
    parameters = {**(document.get("parameters") or {}), **(request.get("parameters") or {})}
    properties = rules.substitute(_properties(document, request), parameters)
    gang = rules.check_nodes(properties, document["type"])
    _check_commands(context, queue, definition, properties, gang)
    fargate.check_platform(document, properties, f"job definition {definition.name}")
    fargate.check_queue(queue.name, [each.document for each in environments_of(context.session, queue)], document)
    _check_secrets(context, queue, gang)
    log_groups.check_room(context.session, gang.log_groups, context.actor.name)
    retry = request.get("retryStrategy") or document.get("retryStrategy") or {}
    timeout = request.get("timeout") or document.get("timeout") or {}
    copy = context.making or context.teacher
    job_id = copy.job if copy else str(uuid.uuid4())  # the same in each try: its run may have the copy already
    is_array = bool(request.get("arrayProperties"))
    named = gang.options.run
    run = named or f"{name[:110]}-{job_id[:8]}"
    _check_run(context, run, bool(named))
    job = Job(
        id=job_id,
        name=name,
        queue=queue.name,
        owner=context.actor.name,
        definition=definition_arn(definition.name, definition.revision),
        kind="array" if is_array else document["type"],
        request=request,
        node_properties=properties,
        from_yaml=gang.spec is not None,
        run=run,
        attempts_allowed=int(retry.get("attempts", 1)),
        evaluate_on_exit=retry.get("evaluateOnExit") or [],
        timeout=timeout.get("attemptDurationSeconds"),
        share=request.get("shareIdentifier"),
        priority=request.get("schedulingPriorityOverride", document.get("schedulingPriority", 0)),
        parameters=parameters,
        tags=request.get("tags") or {},
        created_at=now(),
    )
    gangs.remember(job.id, properties, gang)
    return job, gang


def _check_commands(
    context: Context, queue: JobQueue, definition: JobDefinition, properties: Mapping[str, Any], gang: GangSpec
) -> None:
    """A node without a command runs that of its image, where its engine runs images. Raises ClientError."""
    open_node = next((node for node in gang.nodes if not node.command), None)
    if open_node is None:
        return
    engine = context.reconciler.engine
    if without := engine.without_images(queue_engines(context.session, queue.name, engine.names[0])):
        where = f"job definition {definition.name}"
        if definition.document["type"] == "multinode":
            ranges = properties["nodeRangeProperties"]
            target = next(each["targetNodes"] for each in ranges if each["container"] is open_node.container)
            where = f"node range {target[:20]} of {where}"
        raise ClientError(
            f"{where} has no command, and engine {without[0]} of job queue {queue.name} runs no image, whose ENTRYPOINT "
            "and CMD could stand for one: give a command in the definition or in the overrides, or use a queue of an engine with images "
            "(docker, aws-batch)"
        )


def _check_secrets(context: Context, queue: JobQueue, gang: GangSpec) -> None:
    containers = [node.container for node in gang.nodes if node.container.get("secrets")]
    if containers:
        engines = queue_engines(context.session, queue.name, context.reconciler.engine.names[0])
        try:
            context.reconciler.engine.check_secrets(engines, containers, queue.name)
        except SecretsError as error:
            raise ClientError(str(error)) from None


def _properties(document: Mapping[str, Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """The job's node properties, with the overrides that fit its type."""
    properties = rules.node_properties(document)
    if document["type"] == "multinode":
        check_consumables(request, "the job")
        for key in ("containerOverrides", "ecsPropertiesOverride", "eksPropertiesOverride"):
            if request.get(key):
                raise ClientError(f"{key} is not for a multi-node parallel job; use nodeOverrides")
        if request.get("arrayProperties"):
            raise ClientError("arrayProperties is not for a multi-node parallel job; submit the jobs one by one")
        return rules.override_nodes(properties, request.get("nodeOverrides") or {})
    if request.get("nodeOverrides"):
        raise ClientError("nodeOverrides is for multi-node parallel jobs; use containerOverrides")
    rules.override_range(properties["nodeRangeProperties"][0], request, "container")
    return properties


def _check_run(context: Context, run: str, named: bool) -> None:
    """``named``: the caller chose the name.

    Raises ClientError where it can't be a run's, where the run is not the caller's, or where a job writes it now.
    """
    if not NAME.fullmatch(run):
        raise ClientError(f"MUSTER_RUN {run[:100]!r}: a run is named with letters, digits, '.', '_' and '-'")
    restricted = named and context.actor.queues is not None
    if restricted and (owner := owner_of(context.session, context.found(run))):
        context.actor.check(Operation.SUBMIT_JOB, owner)
    context.reconciler.run_users.check(run)
    if context.reconciler.beginning.get(run) not in (None, context.making, context.teacher):
        raise ClientError(f"run {run} is being begun by another request; try again when that has its answer", 503)
    holder = context.session.scalars(select(Job).where(Job.run == run, Job.status.not_in(TERMINAL)).limit(1)).first()
    if holder and not context.actor.may_see(holder):
        raise ClientError(f"run {run} is being written by another job; choose another name")
    if holder:
        raise ClientError(
            f"run {run} is being written by job {reasons.named(holder.name, holder.id)}; stop it first: muster stop {reasons.short_id(holder.id)}"
        )
    with contextlib.suppress(OSError, ValueError):  # a store that is away, or damaged: the job's own reason says it
        there, version = context.run(run), context.reconciler.run_users.version(run)
        if not named:
            return
        writer, is_kept = context.read(
            ("writer", run, version), lambda: (context.reconciler.peers.writer(there), is_archived(there))
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


def _add_array(context: Context, parent: Job, request: Mapping[str, Any]) -> None:
    """The array and its children, jobs of their own by index; their common facts are stored with the array alone."""
    size = request["arrayProperties"].get("size", 0)
    if size not in _ARRAY_SIZES:
        raise ClientError(f"arrayProperties size is {size}; it must be 2 to 10000")
    if parent.gang.options.run:
        raise ClientError("MUSTER_RUN is for one job; the children of an array have runs of their own")
    parent.array_size = size
    waits = _dependencies(context, request, size)
    parent.dependencies.extend(each for each in waits if each.kind != "SEQUENTIAL")
    context.session.add(parent)
    context.session.flush()
    free = size if not waits else 1 if all(each.kind == "SEQUENTIAL" for each in waits) else 0
    # as the controller would set it at its first look, which then has nothing to write
    since = {"queued_since": parent.created_at - context.reconciler.clock.drift}
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
    note_rows(session, parent.queue, state["status"], Place.CHILD, len(indices))


def _insert_waits(session: Session, parent: Job, wait: Dependency, size: int) -> None:
    """The dependencies of each child, from one entry of ``dependsOn``."""
    index = _numbers(range(1, size) if wait.kind == "SEQUENTIAL" else range(size))
    on: ColumnElement[Any] = literal(wait.on_id, String)
    if wait.kind == "N_TO_N":
        on = literal(f"{wait.on_id}:", String) + cast(index, String)
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


def _dependencies(context: Context, request: Mapping[str, Any], size: int | None) -> Sequence[Dependency]:
    """``dependsOn``, checked; ``size`` of the array that waits, None for another job."""
    wanted = request.get("dependsOn") or []
    if len(wanted) > _MOST_DEPENDENCIES:
        raise ClientError(f"dependsOn has {len(wanted)} entries; at most {_MOST_DEPENDENCIES}")
    found: dict[str, Dependency] = {}
    for entry in wanted:
        kind, reference = entry.get("type"), entry.get("jobId")
        if kind not in (None, "N_TO_N", "SEQUENTIAL"):
            raise ClientError(f"dependsOn type is {kind[:50]!r}; it is N_TO_N or SEQUENTIAL")
        if kind is not None and size is None:
            raise ClientError(f"dependsOn type {kind} is for array jobs")
        if kind == "SEQUENTIAL":
            if reference:
                raise ClientError(
                    "dependsOn SEQUENTIAL is among the children of the array itself and takes no jobId; "
                    "leave the type out to wait for another job"
                )
            found[""] = Dependency(on_id="", kind=kind)
            continue
        if not reference:
            raise ClientError("dependsOn: an entry needs a jobId")
        on_id, node = split_reference(reference)
        job = context.session.get(Job, on_id)
        if job is None or node is not None:
            raise ClientError(f"dependsOn: Job {reference[:200]} does not exist")
        context.actor.check(Operation.SUBMIT_JOB, job)
        if kind == "N_TO_N" and job.array_size != size:
            raise ClientError(f"dependsOn N_TO_N: {reference[:200]} is not an array of the same size ({size})")
        found[on_id] = Dependency(on_id=on_id, kind=kind if kind == "N_TO_N" else None)
    return list(found.values())
