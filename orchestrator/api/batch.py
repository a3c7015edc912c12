"""AWS Batch operations in AWS's own shapes: plain functions from a request to a response.

Requests are validated against the service model that botocore ships (data, not code of ours), then against the rules that the
model can't say.
"""

from __future__ import annotations

import copy
import uuid
from collections.abc import Callable
from functools import cache
from typing import Any

import botocore.session
from botocore.validate import ParamValidator
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from orchestrator.api.describe import definition_arn, describe_job, job_arn, split_reference, summarize
from orchestrator.api.errors import ClientError
from orchestrator.controller import Controller
from orchestrator.database import Job, JobDefinition
from orchestrator.definition import gang_needs, target_nodes
from orchestrator.jobs import Status
from shared_store.layout import NAME

QUEUES = ("default",)
"""The job queues there are."""
_LONGEST_REASON = 1024


@cache
def _model() -> Any:
    return botocore.session.Session().get_service_model("batch")


@cache
def operation_names() -> dict[str, str]:
    """Path name (lower case) → operation, of every operation that AWS Batch has."""
    return {name.lower(): name for name in _model().operation_names}


def validate(operation: str, request: object) -> dict[str, Any]:
    """The request, checked against AWS's model. Raises ClientError with what is wrong, in one line."""
    if not isinstance(request, dict):
        raise ClientError(f"{operation}: expected a JSON object")
    report = ParamValidator().validate(request, _model().operation_model(operation).input_shape)
    if report.has_errors():
        raise ClientError(f"Error executing request, Exception : {' '.join(report.generate_report().split())}")
    return request


def call(controller: Controller, operation: str, request: object) -> dict[str, Any]:
    """Carry out one operation. Raises ClientError."""
    handler = OPERATIONS.get(operation)
    if handler is None:
        raise ClientError(f"{operation} is not supported; supported are {', '.join(OPERATIONS)}")
    checked = validate(operation, request)
    with controller.writing, controller.database.session() as session:
        response = handler(session, checked)
    controller.wake()
    return response


def register_job_definition(session: Session, request: dict[str, Any]) -> dict[str, Any]:
    """RegisterJobDefinition for ``multinode`` definitions; each registration of a name is a new revision."""
    name = request["jobDefinitionName"]
    if not NAME.fullmatch(name) or "." in name:
        raise ClientError(f"jobDefinitionName {name!r}: up to 128 letters, digits, hyphens and underscores")
    if request["type"] != "multinode" or "nodeProperties" not in request:
        raise ClientError(f"job definition {name}: only type multinode with nodeProperties is supported")
    _check_nodes(request["nodeProperties"])
    _check_attempts(request)
    revision = (session.scalar(select(func.max(JobDefinition.revision)).where(JobDefinition.name == name)) or 0) + 1
    session.add(JobDefinition(name=name, revision=revision, document=request))
    return {"jobDefinitionName": name, "jobDefinitionArn": definition_arn(name, revision), "revision": revision}


def submit_job(session: Session, request: dict[str, Any]) -> dict[str, Any]:
    """SubmitJob, with environment, command and resource overrides by node range."""
    name = request["jobName"]
    if not NAME.fullmatch(name) or "." in name:
        raise ClientError(
            f"jobName {name!r}: up to 128 letters, digits, hyphens and underscores, a letter or digit first"
        )
    queue = request["jobQueue"].rpartition("/")[2]
    if queue not in QUEUES:
        raise ClientError(f"Job queue {request['jobQueue']} does not exist; there is {', '.join(QUEUES)}")
    definition = _find_definition(session, request["jobDefinition"])
    for key in ("arrayProperties", "dependsOn", "containerOverrides", "ecsPropertiesOverride", "eksPropertiesOverride"):
        if request.get(key):
            raise ClientError(f"{key} is not supported for multi-node parallel jobs here")
    _check_attempts(request)
    properties = _apply_overrides(definition.document["nodeProperties"], request.get("nodeOverrides") or {})
    _check_nodes(properties, overridden=True)
    retry = request.get("retryStrategy") or definition.document.get("retryStrategy") or {}
    timeout = request.get("timeout") or definition.document.get("timeout") or {}
    job_id = str(uuid.uuid4())
    run = gang_needs(properties).setting("MUSTER_RUN") or f"{name}-{job_id[:8]}"
    if not NAME.fullmatch(run):
        raise ClientError(f"MUSTER_RUN {run!r}: a run is named with letters, digits, '.', '_' and '-'")
    holder = session.scalar(
        select(Job).where(Job.run == run, Job.status.not_in([Status.SUCCEEDED, Status.FAILED])).limit(1)
    )
    if holder:
        raise ClientError(
            f"run {run} is being written by job {holder.name} ({holder.id[:8]}); stop it first: muster stop {holder.id[:8]}"
        )
    session.add(
        Job(
            id=job_id,
            name=name,
            queue=queue,
            definition=definition_arn(definition.name, definition.revision),
            request=request,
            node_properties=properties,
            run=run,
            attempts_allowed=int(retry.get("attempts", 1)),
            timeout=timeout.get("attemptDurationSeconds"),
        )
    )
    return {"jobArn": job_arn(job_id), "jobName": name, "jobId": job_id}


def describe_jobs(session: Session, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeJobs for parents and for nodes (``id#N``, ``arn#N``); unknown ids are passed over, as on AWS."""
    if len(request["jobs"]) > 100:
        raise ClientError("DescribeJobs takes at most 100 jobs")
    found = []
    for reference in request["jobs"]:
        job_id, node = split_reference(reference)
        job = session.get(Job, job_id)
        if job and (node is None or node < int(job.node_properties["numNodes"])):
            found.append(describe_job(job, _definition_of(session, job), node))
    return {"jobs": found}


def list_jobs(session: Session, request: dict[str, Any]) -> dict[str, Any]:
    """ListJobs by queue (RUNNING where no status is given; all statuses with a filter), or the nodes of one job."""
    given = [key for key in ("jobQueue", "arrayJobId", "multiNodeJobId") if request.get(key)]
    if len(given) != 1:
        raise ClientError("ListJobs: give exactly one of jobQueue, arrayJobId, multiNodeJobId")
    if request.get("arrayJobId"):
        return {"jobSummaryList": []}
    start, size = _page(request, 100 if request.get("filters") else 1000)
    if request.get("multiNodeJobId"):
        job = session.get(Job, split_reference(request["multiNodeJobId"])[0])
        summaries = [summarize(job, node) for node in range(int(job.node_properties["numNodes"]))] if job else []
        wanted = request.get("jobStatus")
        summaries = [s for s in summaries if not wanted or s["status"] == wanted]
    else:
        if request["jobQueue"].rpartition("/")[2] not in QUEUES:
            raise ClientError(f"Job queue {request['jobQueue']} does not exist; there is {', '.join(QUEUES)}")
        query = select(Job).order_by(Job.created_at.desc(), Job.id)
        query = query.where(*_conditions(request))
        summaries = [summarize(job) for job in session.scalars(query.offset(start).limit(size + 1))]
        more = len(summaries) > size
        return {"jobSummaryList": summaries[:size], **({"nextToken": str(start + size)} if more else {})}
    page = summaries[start : start + size]
    return {"jobSummaryList": page, **({"nextToken": str(start + size)} if len(summaries) > start + size else {})}


def terminate_job(session: Session, request: dict[str, Any]) -> dict[str, Any]:
    """TerminateJob: SIGTERM, grace, SIGKILL, FAILED; a job that is over is left as it is."""
    if len(request["reason"]) > _LONGEST_REASON:
        raise ClientError(f"TerminateJob: the reason is longer than {_LONGEST_REASON} characters")
    job_id, node = split_reference(request["jobId"])
    if node is not None:
        raise ClientError("TerminateJob: a single node can't be terminated; terminate the job")
    job = session.get(Job, job_id)
    if job is None:
        raise ClientError(f"Job {request['jobId']} does not exist")
    if not Status(job.status).is_terminal and job.stop_reason is None:
        job.stop_reason = request["reason"]
    return {}


OPERATIONS: dict[str, Callable[[Session, dict[str, Any]], dict[str, Any]]] = {
    "RegisterJobDefinition": register_job_definition,
    "SubmitJob": submit_job,
    "DescribeJobs": describe_jobs,
    "ListJobs": list_jobs,
    "TerminateJob": terminate_job,
}


def _check_nodes(properties: dict[str, Any], overridden: bool = False) -> None:
    count, main, ranges = properties["numNodes"], properties["mainNode"], properties["nodeRangeProperties"]
    if not 1 <= count <= 1000:
        raise ClientError(f"numNodes is {count}; a multi-node parallel job has 1 to 1000 nodes")
    if not 0 <= main < count:
        raise ClientError(f"mainNode is {main}; it must be less than numNodes ({count})")
    if not 1 <= len(ranges) <= 5:
        raise ClientError(f"{len(ranges)} node ranges; a multi-node parallel job has 1 to 5")
    for entry in ranges:
        container = entry.get("container")
        if container is None:
            raise ClientError(f"node range {entry['targetNodes']}: only container properties are supported")
        for pair in container.get("environment") or []:
            if pair.get("name", "").startswith("AWS_BATCH"):
                raise ClientError(f"environment variable {pair['name']}: names that start with AWS_BATCH are reserved")
        if not container.get("command"):
            raise ClientError(f"node range {entry['targetNodes']}: has no command")
    try:
        needs = gang_needs(properties)
    except ValueError as error:
        raise ClientError(str(error)) from None
    for node in needs.nodes:
        if node.cpus <= 0 or node.memory < 4 or node.gpus < 0:
            raise ClientError("resourceRequirements: VCPU must be positive, MEMORY at least 4 (MiB), GPU not negative")


def _check_attempts(request: dict[str, Any]) -> None:
    attempts = (request.get("retryStrategy") or {}).get("attempts", 1)
    if not 1 <= attempts <= 10:
        raise ClientError(f"retryStrategy attempts is {attempts}; it must be 1 to 10")
    if (request.get("retryStrategy") or {}).get("evaluateOnExit"):
        raise ClientError("retryStrategy evaluateOnExit is not supported; give attempts alone")
    seconds = (request.get("timeout") or {}).get("attemptDurationSeconds", 60)
    if seconds < 60:
        raise ClientError(f"timeout attemptDurationSeconds is {seconds}; it must be at least 60")


def _find_definition(session: Session, reference: str) -> JobDefinition:
    name, _, revision = reference.rpartition("/")[2].partition(":")
    query = select(JobDefinition).where(JobDefinition.name == name, JobDefinition.status == "ACTIVE")
    if revision:
        if not revision.isdigit():
            raise ClientError(f"Job definition {reference}: the revision must be a number")
        query = query.where(JobDefinition.revision == int(revision))
    found = session.scalars(query.order_by(JobDefinition.revision.desc()).limit(1)).first()
    if found is None:
        raise ClientError(f"Job definition {reference} does not exist or is not active")
    return found


def _definition_of(session: Session, job: Job) -> JobDefinition:
    name, _, revision = job.definition.rpartition("/")[2].partition(":")
    definition = session.get(JobDefinition, (name, int(revision)))
    assert definition is not None
    return definition


def _apply_overrides(properties: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """nodeOverrides on nodeProperties: environment merges by name, command replaces, resources replace by type."""
    result = copy.deepcopy(properties)
    if (count := overrides.get("numNodes")) is not None:
        if not any(entry["targetNodes"].endswith(":") for entry in result["nodeRangeProperties"]):
            raise ClientError(
                "numNodes can be overridden only where a node range of the definition has an open end, such as 0:"
            )
        result["numNodes"] = count
    ranges = {entry["targetNodes"]: entry for entry in result["nodeRangeProperties"]}
    for override in overrides.get("nodePropertyOverrides") or []:
        target = override["targetNodes"]
        if target not in ranges:
            raise ClientError(f"NodeOverride targets should match job definition. Non matching targets - {target}")
        container, changes = ranges[target]["container"], override.get("containerOverrides") or {}
        if changes.get("command"):
            container["command"] = changes["command"]
        for key, name in (("environment", "name"), ("resourceRequirements", "type")):
            merged = {pair[name]: pair for pair in [*(container.get(key) or []), *(changes.get(key) or [])]}
            container[key] = list(merged.values())
    for target in ranges:
        try:
            target_nodes(target, result["numNodes"])
        except ValueError as error:
            raise ClientError(str(error)) from None
    return result


def _conditions(request: dict[str, Any]) -> list[Any]:
    filters = request.get("filters") or []
    if len(filters) > 1:
        raise ClientError("ListJobs takes one filter at a time")
    if not filters:
        return [Job.status == request.get("jobStatus", Status.RUNNING)]
    name, values = filters[0].get("name"), filters[0].get("values") or []
    if not values:
        raise ClientError(f"ListJobs: filter {name} has no values")
    value = values[0]
    if name == "JOB_NAME":
        if value.endswith("*"):
            return [func.lower(Job.name).startswith(value[:-1].lower(), autoescape=True)]
        return [func.lower(Job.name) == value.lower()]
    if name in ("BEFORE_CREATED_AT", "AFTER_CREATED_AT"):
        if not value.isdigit():
            raise ClientError(f"ListJobs: filter {name} takes a time in milliseconds, not {value!r}")
        return [Job.created_at < int(value) if name == "BEFORE_CREATED_AT" else Job.created_at > int(value)]
    raise ClientError(f"ListJobs: filter {name} is not supported; use JOB_NAME, BEFORE_CREATED_AT or AFTER_CREATED_AT")


def _page(request: dict[str, Any], most: int) -> tuple[int, int]:
    token = request.get("nextToken") or "0"
    if not token.isdigit():
        raise ClientError(f"ListJobs: nextToken {token!r} is not one that was given out")
    return int(token), max(1, min(request.get("maxResults") or most, most))
