"""Descriptions of jobs in AWS Batch's shapes (JobDetail, JobSummary)."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from typing import Any

from orchestrator.api.batch.ecs import to_ecs
from orchestrator.api.batch.fargate import is_fargate
from orchestrator.domain.job import Ending, Status, container_reason, has_exited
from orchestrator.persistence.batch_models import Attempt, Job, JobDefinition
from orchestrator.services.arns import ecs_arn, job_arn, queue_arn
from orchestrator.services.damaged_rows import DAMAGED

_LISTS = ("command", "environment", "mountPoints", "resourceRequirements", "secrets", "ulimits", "volumes")


def describe_job(job: Job, definition: JobDefinition, node: int | None, reason: str | None) -> dict[str, Any]:
    """JobDetail. The parent of a multi-node job has no ``container``; a node (``id#N``) has one, and ``nodeDetails``.

    Args:
        job: The job.
        definition: Its definition.
        node: Index of one node of a multi-node job; None for the whole.
        reason: Why the job waits just now; None where it does not wait.
    """
    document = definition.document
    detail: dict[str, Any] = {
        **_common(job, reason),
        "jobQueue": queue_arn(job.queue),
        "retryStrategy": retry_strategy({"attempts": job.attempts_allowed, "evaluateOnExit": job.evaluate_on_exit}),
        "timeout": {"attemptDurationSeconds": job.timeout} if job.timeout else None,
        "parameters": job.parameters,
        "dependsOn": [_dependency(each.on_id, each.kind) for each in job.dependencies],
        "tags": job.tags,
        # echoes of the submission and of the definition, which nothing else reads
        "propagateTags": bool(job.request.get("propagateTags", document.get("propagateTags", False))),
        "platformCapabilities": document.get("platformCapabilities", ["EC2"]),
        "eksAttempts": [],
        "shareIdentifier": job.share,
        "schedulingPriority": job.priority if job.share else None,
        "isCancelled": job.cancelled,
        "isTerminated": job.stop_reason is not None and not job.cancelled,
    }
    gang = job.gang
    index = gang.main if node is None else node
    detail["attempts"] = [_attempt(job, attempt, index) for attempt in job.attempts if attempt.stopped_at]
    last = job.attempts[-1] if job.attempts else None
    if node is not None:
        detail |= _node_identity(job, node)
        detail |= _end_of_node(job, node)
        detail["nodeDetails"] = {"nodeIndex": node, "isMainNode": node == gang.main}
    if job.kind == "multinode" and node is None:
        detail["nodeProperties"] = node_ranges(job.node_properties)  # an echo: range by range, as it was submitted
    else:
        spec = gang.nodes[node or 0]
        shown = {
            **with_defaults(spec.container, {} if spec.ecs else document),
            **(_container(job, last, node or 0) if last else {}),
        }
        if spec.ecs is not None:
            detail["container"], detail["ecsProperties"] = {}, _in_ecs(shown, spec.ecs)
        else:
            detail["container"] = shown
    return {key: value for key, value in detail.items() if value is not None}


def _end_of_node(job: Job, node: int) -> dict[str, Any]:
    """The members of a node that has ended while others still run: when and how it ended, and its attempt."""
    last = job.attempts[-1] if job.attempts else None
    record = last.node(node) if last else None
    if record is None or job.status == Status.RUNNABLE or record.exit_code is None:
        return {}
    attempts = [_attempt(job, attempt, node) for attempt in job.attempts]
    return {**_own_end(job, node), "attempts": attempts}


def _own_end(job: Job, node: int) -> dict[str, Any]:
    """When and how a node ended by itself; nothing for one that runs, or was ended with its gang."""
    last = job.attempts[-1] if job.attempts else None
    record = last.node(node) if last else None
    if last is None or job.status == Status.RUNNABLE or record is None or record.status_reason is None:
        return {}
    attempt = _attempt(job, last, node)
    return {key: attempt[key] for key in ("stoppedAt", "statusReason")}


def _in_ecs(container: Mapping[str, Any], name: str) -> dict[str, Any]:
    task = {key: container[key] for key in ("containerInstanceArn", "taskArn") if key in container}
    return to_ecs(container, name, task)


def retry_strategy(strategy: Mapping[str, Any]) -> dict[str, Any]:
    """``retryStrategy`` as AWS shows it; ``action`` is taken in any case, and shown in that of the model."""
    conditions = strategy.get("evaluateOnExit") or []
    return {**strategy, "evaluateOnExit": [{**each, "action": each["action"].upper()} for each in conditions]}


def with_defaults(container: Mapping[str, Any], definition: Mapping[str, Any]) -> dict[str, Any]:
    """``containerProperties`` with what AWS shows for missing members: empty lists, and Fargate's platform."""
    platform = {"fargatePlatformConfiguration": {"platformVersion": "LATEST"}} if is_fargate(definition) else {}
    return {**{name: [] for name in _LISTS}, **platform, **container}


def node_ranges(properties: Mapping[str, Any]) -> dict[str, Any]:
    """``nodeProperties`` as AWS shows them: each range as it was defined, by ``container`` or by ``ecsProperties``."""
    return {**properties, "nodeRangeProperties": [_range(entry) for entry in properties["nodeRangeProperties"]]}


def ecs_with_defaults(properties: Mapping[str, Any]) -> dict[str, Any]:
    """``ecsProperties`` with empty lists for missing members."""
    in_task = [name for name in _LISTS if name != "volumes"]
    tasks = [
        {
            "volumes": [],
            **task,
            "containers": [{**{name: [] for name in in_task}, **each} for each in task["containers"]],
        }
        for task in properties["taskProperties"]
    ]
    return {"taskProperties": tasks}


def _range(entry: Mapping[str, Any]) -> dict[str, Any]:
    rest = {key: value for key, value in entry.items() if key != "ecs"}
    if "ecsProperties" in entry:
        return {**rest, "ecsProperties": ecs_with_defaults(entry["ecsProperties"])}
    container = with_defaults(entry["container"], {})
    if "ecs" in entry:  # of a job, which keeps all in one form
        del rest["container"]
        return {**rest, "ecsProperties": to_ecs(container, entry["ecs"], {})}
    return {**rest, "container": container}


def array_properties(job: Job, counts: Mapping[str, int]) -> dict[str, Any] | None:
    """``arrayProperties`` of an array (with the number of its children by state) or of a child of one."""
    if job.kind == "array":
        summary = {str(status): counts.get(status, 0) for status in Status}
        return {"size": job.array_size, "statusSummary": summary}
    if job.parent is not None:
        return {"index": job.array_index, "size": job.array_size}
    return None


def summarize(job: Job, reason: str | None = None, node: int | None = None) -> dict[str, Any]:
    """JobSummary of a job, or of one of its nodes."""
    summary, gang = _common(job, reason), job.gang
    if job.kind == "multinode":
        summary["nodeProperties"] = {"numNodes": len(gang.nodes)}
        if node is not None:
            summary |= _node_identity(job, node)
            summary["nodeProperties"] |= {"nodeIndex": node, "isMainNode": node == gang.main}
        summary |= _own_end(job, node) if node is not None else {}
    elif job.array_size is not None:
        summary["arrayProperties"] = {"size": job.array_size}
        if job.array_index is not None:
            summary["arrayProperties"]["index"] = job.array_index
    index = gang.main if node is None else node
    summary["container"] = (_exit(job, job.attempts[-1], index) if job.attempts else {}) or None
    if job.share:
        summary["shareIdentifier"] = job.share
    if job.stop_reason is not None:  # AWS shows only the one that is true
        summary["isCancelled" if job.cancelled else "isTerminated"] = True
    return {key: value for key, value in summary.items() if value is not None}


def describe_damaged(job: Job, reason: str | None) -> dict[str, Any]:
    """JobSummary of a job whose row is damaged: the readable facts, and a reason that tells of the damage."""
    summary = _common(job, reason)
    reason_text = summary["statusReason"] or ""
    summary["statusReason"] = (
        reason_text if DAMAGED in reason_text else f"{reason_text}; {DAMAGED}" if reason_text else DAMAGED
    )
    return {key: value for key, value in summary.items() if value is not None}


def node_status(job: Job, node: int) -> str:
    """A node's own state: by its exit code where it ended, else the job's; between two attempts it waits like all others."""
    if job.status == Status.RUNNABLE:
        return job.status
    record = job.attempts[-1].node(node) if job.attempts else None
    if record is not None and record.exit_code is not None:
        return str(Status.SUCCEEDED if record.exit_code == 0 else Status.FAILED)
    return job.status


def stream_name(job: Job, attempt: int, node: int, prefix: str | None = None) -> str:
    """Name of the log stream of one node and attempt; AWS allows no colon in it, which the ids of array children have.

    ``prefix``: of its container's ``logConfiguration``, where that has one.
    """
    return f"{prefix or job.name}/{job.id.replace(':', '.')}/{attempt}/node-{node}"


def _common(job: Job, reason: str | None) -> dict[str, Any]:
    return {
        "jobArn": job_arn(job.id),
        "jobId": job.id,
        "jobName": job.name,
        "jobDefinition": job.definition,
        "status": job.status,
        "statusReason": reason or job.status_reason,
        "createdAt": job.created_at,
        "startedAt": job.started_at,
        "stoppedAt": job.stopped_at,
    }


def _node_identity(job: Job, node: int) -> dict[str, Any]:
    return {"jobId": f"{job.id}#{node}", "jobArn": f"{job_arn(job.id)}#{node}", "status": node_status(job, node)}


def _dependency(on: str, kind: str | None) -> dict[str, str]:
    return {"jobId": on, **({"type": kind} if kind else {})}


def _attempt(job: Job, attempt: Attempt, node: int) -> dict[str, Any]:
    record, container, ecs = attempt.node(node), _container(job, attempt, node), job.gang.nodes[node].ecs
    stopped = (record and record.stopped_at) or attempt.stopped_at
    detail = {
        "container": container if ecs is None else {},
        "taskProperties": None if ecs is None else _in_ecs(container, ecs)["taskProperties"],
        "startedAt": attempt.started_at,
        "stoppedAt": stopped and max(stopped, attempt.started_at or stopped),  # clocks of hosts differ
        "statusReason": (record and record.status_reason) or attempt.status_reason,
    }
    return {key: value for key, value in detail.items() if value is not None}


def _exit(job: Job, attempt: Attempt, node: int) -> dict[str, Any]:
    """``exitCode`` and ``reason`` of a container, those that ``evaluateOnExit`` sees; empty while it runs."""
    record = attempt.node(node)
    if record is None:
        return {}
    decided = attempt.status_reason if node == job.gang.main and attempt.ending != Ending.STOPPED else None
    status = record.status_reason or decided
    code, reason = record.exit_code if has_exited(status) else None, container_reason(record.reason, status)
    return {**({} if code is None else {"exitCode": code}), **({"reason": reason[:255]} if reason else {})}


def _container(job: Job, attempt: Attempt, node: int) -> dict[str, Any]:
    record = attempt.node(node)
    detail = {
        **_exit(job, attempt, node),
        "logStreamName": stream_name(job, attempt.number, node, record.log_prefix if record else None)
        if attempt.started_at
        else None,
        "containerInstanceArn": ecs_arn("container-instance", attempt.environment, record.host) if record else None,
        "taskArn": ecs_arn(
            "task", attempt.environment, uuid.uuid5(uuid.NAMESPACE_OID, f"{job.id}/{attempt.number}/{node}").hex
        ),
        "networkInterfaces": [{"privateIpv4Address": record.address}] if record and record.address else [],
    }
    return {key: value for key, value in detail.items() if value is not None}
