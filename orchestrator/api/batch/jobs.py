"""The Batch API's operations on jobs: DescribeJobs, ListJobs, TerminateJob(s), CancelJob(s)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import selectinload

from orchestrator.api.batch.descriptions import array_properties, describe_damaged, describe_job, node_status, summarize
from orchestrator.api.batch.paging import decode, encode, page, page_size
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Job
from orchestrator.services.arns import definition_arn, queue_arn, split_reference
from orchestrator.services.context import Context
from orchestrator.services.damaged_rows import DamagedRow, reading
from orchestrator.services.permissions import JobsOf, Operation
from orchestrator.services.stop import UnknownJob, check_reason, end


def describe_jobs(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeJobs for jobs, nodes (``id#N``, ``arn#N``) and array children (``id:N``); unknown ids are passed over."""
    requested, found = [split_reference(reference) for reference in request["jobs"]], []
    query = select(Job).where(Job.id.in_({job_id for job_id, _ in requested})).options(selectinload(Job.attempts))
    jobs = {job.id: job for job in context.session.scalars(query)}
    for job_id, node in requested:
        job = jobs.get(job_id)
        if job is None or not context.actor.may_see(job):
            continue
        reason = context.reason(job)
        try:
            with reading(job):
                if node is not None and not (job.kind == "multinode" and 0 <= node < len(job.gang.nodes)):
                    continue
                detail = describe_job(job, context.definition_of(job), node, reason)
        except DamagedRow:
            detail = {**describe_damaged(job, reason), "jobQueue": queue_arn(job.queue)}
        if (array := array_properties(job, _count_children(context, job))) is not None:
            detail["arrayProperties"] = array
        found.append(detail)
    return {"jobs": found}


def list_jobs(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """ListJobs of a queue, of an array's children, or of a gang's nodes.

    Without a status only RUNNING ones are listed. A filter applies to a queue only, and lists jobs in all states.
    """
    named = [key for key in ("jobQueue", "arrayJobId", "multiNodeJobId") if request.get(key)]
    if len(named) != 1:
        raise ClientError("ListJobs: give exactly one of jobQueue, arrayJobId, multiNodeJobId")
    if (status := request.get("jobStatus")) and status not in list(Status):
        raise ClientError(f"jobStatus is {status[:50]!r}; it is one of {', '.join(Status)}")
    if request.get("multiNodeJobId"):
        return _list_nodes(context, request)
    if array := request.get("arrayJobId"):
        job_id, _ = split_reference(array)
        if (parent := context.session.get(Job, job_id)) is not None:
            context.actor.check(Operation.LIST_JOBS, parent)
        status = request.get("jobStatus", Status.RUNNING)
        query = select(Job).where(Job.parent == job_id, Job.status == status).order_by(Job.array_index, Job.id)
        query = query.options(selectinload(Job.attempts))
        rows, token = page(context.session, query, request, Job.array_index, Job.id, most=1000)
    else:
        queue = context.queue(request["jobQueue"], deleting=True)
        context.actor.check(Operation.LIST_JOBS, JobsOf(queue.name))
        conditions = _conditions(request)
        query = select(Job).where(Job.queue == queue.name, Job.parent.is_(None), *conditions)
        query = query.order_by(Job.created_at.desc(), Job.id.desc()).options(selectinload(Job.attempts))
        most, keys = 100 if request.get("filters") else 1000, (Job.created_at, Job.id)
        rows, token = page(context.session, query, request, *keys, descending=(True, True), most=most)
    return {"jobSummaryList": [_summary(job, context.reason(job)) for job in rows], **token}


def _summary(job: Job, reason: str | None) -> dict[str, Any]:
    try:
        with reading(job):
            return summarize(job, reason)
    except DamagedRow:
        return describe_damaged(job, reason)


def _list_nodes(context: Context, request: Mapping[str, Any]) -> dict[str, Any]:
    job = context.session.get(Job, split_reference(request["multiNodeJobId"])[0])
    if job is None or job.kind != "multinode":
        return {"jobSummaryList": []}
    context.actor.check(Operation.LIST_JOBS, job)
    requested, reason = request.get("jobStatus", Status.RUNNING), context.reason(job)
    with reading(job):
        nodes = [node for node in range(len(job.gang.nodes)) if node_status(job, node) == requested]
    token = request.get("nextToken")
    start = decode(token, [int])[0] if token else 0
    if start < 0:
        raise ClientError(f"nextToken {str(token)[:100]!r} is not one that was given out")
    end = start + page_size(dict(request), 1000)
    more = {"nextToken": encode([end])} if len(nodes) > end else {}
    with reading(job):
        return {"jobSummaryList": [summarize(job, reason, node) for node in nodes[start:end]], **more}


def _conditions(request: Mapping[str, Any]) -> Sequence[Any]:
    filters = request.get("filters") or []
    if len(filters) > 1:
        raise ClientError("ListJobs takes one filter at a time")
    if not filters:
        return [Job.status == request.get("jobStatus", Status.RUNNING)]
    name, values = filters[0].get("name"), filters[0].get("values") or []
    if len(values) != 1:
        raise ClientError(f"ListJobs: filter {name} has {len(values)} values; it takes one")
    value = values[0]
    match name:
        case "JOB_NAME":
            if value.endswith("*"):
                return [func.lower(Job.name).startswith(value[:-1].lower(), autoescape=True)]
            return [func.lower(Job.name) == value.lower()]
        case "JOB_DEFINITION":
            return [_by_definition(value)]
        case "BEFORE_CREATED_AT" | "AFTER_CREATED_AT":
            if not (value.isascii() and value.isdigit() and len(value) < 16):
                raise ClientError(f"ListJobs: filter {name} takes a time in milliseconds, not {value[:50]!r}")
            return [Job.created_at < int(value) if name == "BEFORE_CREATED_AT" else Job.created_at > int(value)]
        case "SHARE_IDENTIFIER":
            status = request.get("jobStatus")  # the one filter that goes with a status
            return [Job.share == value, *([Job.status == status] if status else [])]
    raise ClientError(
        f"ListJobs: filter {str(name)[:50]!r} is not known; use JOB_NAME, JOB_DEFINITION, BEFORE_CREATED_AT, "
        "AFTER_CREATED_AT or SHARE_IDENTIFIER"
    )


def _by_definition(value: str) -> Any:
    """A definition's name (any revision), name:revision or ARN; only a name may end in ``*``. The case matters."""
    if value.startswith("arn:"):
        return Job.definition == value
    name, _, revision = value.partition(":")
    place = len(definition_arn("", 1)) - 1  # of the name in an ARN, from 1
    if revision and not value.endswith("*"):
        return func.substr(Job.definition, place) == value
    start = value[:-1] if value.endswith("*") else f"{name}:"
    return func.substr(Job.definition, place, len(start)) == start  # LIKE would not heed the case in SQLite


def terminate_job(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """TerminateJob: SIGTERM, grace, SIGKILL, FAILED; a job that does not run yet is cancelled; a finished job is left unchanged."""
    _end(context, request["jobId"], request["reason"], Operation.TERMINATE_JOB)
    return {}


def cancel_job(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """CancelJob: FAILED for a job that has not begun to start; for a later one nothing, without an error, as on AWS."""
    _end(context, request["jobId"], request["reason"], Operation.CANCEL_JOB)
    return {}


def terminate_jobs(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """TerminateJobs: TerminateJob for up to 50 jobs, each with its own result."""
    return _end_each(context, request, Operation.TERMINATE_JOBS)


def cancel_jobs(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """CancelJobs: CancelJob for up to 50 jobs, each with its own result."""
    return _end_each(context, request, Operation.CANCEL_JOBS)


def _end(context: Context, reference: str, reason: str, operation: Operation) -> None:
    job_id, node = split_reference(reference)
    if node is not None:
        raise ClientError(f"{operation}: a single node can't be ended; give the job's id")
    end(context, job_id, reason, operation, only_waiting=operation in (Operation.CANCEL_JOB, Operation.CANCEL_JOBS))


def _end_each(context: Context, request: Mapping[str, Any], operation: Operation) -> dict[str, Any]:
    """The result for each job; as on AWS, one that does not exist counts as ended."""
    check_reason(request["reason"], operation)
    if not request["jobs"]:
        raise ClientError(f"{operation} takes at least one job")
    successful: list[str] = []
    errors: list[dict[str, str]] = []
    for reference in request["jobs"]:
        try:
            _end(context, reference, request["reason"], operation)
        except UnknownJob:
            pass
        except ClientError as error:
            code = "AccessDenied" if error.status == 403 else "ValidationException"
            errors.append({"job": reference, "code": code, "message": str(error)})
            continue
        successful.append(reference)
    return {"successful": successful, "errors": errors}


def _count_children(context: Context, job: Job) -> Mapping[str, int]:
    if job.kind != "array":
        return {}
    query = select(Job.status, func.count()).where(Job.parent == job.id).group_by(Job.status)
    return {status: count for status, count in context.session.execute(query)}
