"""How a job looks in AWS Batch's shapes (JobDetail, JobSummary), and ARNs."""

from __future__ import annotations

from typing import Any

from orchestrator.database import Attempt, Job, JobDefinition
from orchestrator.definition import target_nodes
from orchestrator.jobs import Status, main_container

REGION, ACCOUNT = "us-east-1", "000000000000"
_PREFIX = f"arn:aws:batch:{REGION}:{ACCOUNT}:"


def job_arn(job_id: str) -> str:
    return f"{_PREFIX}job/{job_id}"


def definition_arn(name: str, revision: int) -> str:
    return f"{_PREFIX}job-definition/{name}:{revision}"


def queue_arn(name: str) -> str:
    return f"{_PREFIX}job-queue/{name}"


def split_reference(reference: str) -> tuple[str, int | None]:
    """Job id and node index of ``id``, ``arn``, ``id#N`` or ``arn#N``."""
    base, sign, node = reference.rpartition("/")[2].partition("#")
    return (base, int(node)) if sign and node.isdigit() else (base, None)


def describe_job(job: Job, definition: JobDefinition, node: int | None) -> dict[str, Any]:
    """JobDetail. The parent of a multi-node job has no ``container``; a node (``id#N``) has one, and ``nodeDetails``."""
    document = definition.document
    detail: dict[str, Any] = {
        "jobArn": job_arn(job.id),
        "jobId": job.id,
        "jobName": job.name,
        "jobQueue": queue_arn(job.queue),
        "jobDefinition": job.definition,
        "status": job.status,
        "statusReason": job.status_reason,
        "createdAt": job.created_at,
        "startedAt": job.started_at,
        "stoppedAt": job.stopped_at,
        "retryStrategy": {"attempts": job.attempts_allowed, "evaluateOnExit": []},
        "timeout": {"attemptDurationSeconds": job.timeout} if job.timeout else None,
        "parameters": {},
        "dependsOn": [],
        "tags": {**(document.get("tags") or {}), **(job.request.get("tags") or {})},
        "isCancelled": False,
        "isTerminated": job.stop_reason is not None,
    }
    index = int(job.node_properties["mainNode"]) if node is None else node
    detail["attempts"] = [_attempt(job, attempt, index) for attempt in job.attempts if attempt.stopped_at]
    if node is None:
        detail["nodeProperties"] = job.node_properties
    else:
        detail["jobId"], detail["jobArn"] = f"{job.id}#{node}", f"{job_arn(job.id)}#{node}"
        detail["nodeDetails"] = {"nodeIndex": node, "isMainNode": node == job.node_properties["mainNode"]}
        last = job.attempts[-1] if job.attempts else None
        detail["container"] = {**_container_of(job, node), **(_container(job, last, node) if last else {})}
        detail["status"] = node_status(job, node)
    return {key: value for key, value in detail.items() if value is not None}


def summarize(job: Job, node: int | None = None) -> dict[str, Any]:
    """JobSummary of a job, or of one of its nodes."""
    main = job.node_properties["mainNode"]
    summary: dict[str, Any] = {
        "jobArn": job_arn(job.id),
        "jobId": job.id,
        "jobName": job.name,
        "jobDefinition": job.definition,
        "status": job.status,
        "statusReason": job.status_reason,
        "createdAt": job.created_at,
        "startedAt": job.started_at,
        "stoppedAt": job.stopped_at,
        "nodeProperties": {"numNodes": job.node_properties["numNodes"]},
    }
    if node is not None:
        summary["jobId"], summary["jobArn"] = f"{job.id}#{node}", f"{job_arn(job.id)}#{node}"
        summary["nodeProperties"] = {**summary["nodeProperties"], "nodeIndex": node, "isMainNode": node == main}
        summary["status"] = node_status(job, node)
    return {key: value for key, value in summary.items() if value is not None}


def node_status(job: Job, node: int) -> str:
    """A node's own state: by its exit code where it ended, else the job's."""
    record = main_container(job.attempts[-1].nodes, node) if job.attempts else {}
    if "exitCode" in record:
        return str(Status.SUCCEEDED if record["exitCode"] == 0 else Status.FAILED)
    return job.status


def stream_name(job: Job, attempt: int, node: int) -> str:
    """Name of the log stream of one node and attempt."""
    return f"{job.name}/{job.id}/{attempt}/node-{node}"


def _attempt(job: Job, attempt: Attempt, node: int) -> dict[str, Any]:
    detail = {
        "container": _container(job, attempt, node),
        "startedAt": attempt.started_at,
        "stoppedAt": attempt.stopped_at,
        "statusReason": attempt.status_reason,
    }
    return {key: value for key, value in detail.items() if value is not None}


def _container(job: Job, attempt: Attempt, node: int) -> dict[str, Any]:
    record = main_container(attempt.nodes, node)
    detail = {
        "exitCode": record.get("exitCode"),
        "reason": str(record["reason"])[:255] if record.get("reason") else None,
        "logStreamName": stream_name(job, attempt.number, node) if attempt.started_at else None,
        "networkInterfaces": [{"privateIpv4Address": record["address"]}] if record.get("address") else [],
    }
    return {key: value for key, value in detail.items() if value is not None}


def _container_of(job: Job, node: int) -> dict[str, Any]:
    count = job.node_properties["numNodes"]
    ranges = [e for e in job.node_properties["nodeRangeProperties"] if node in target_nodes(e["targetNodes"], count)]
    innermost = min(ranges, key=lambda entry: len(target_nodes(entry["targetNodes"], count)))
    return dict(innermost["container"])
