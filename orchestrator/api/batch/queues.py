"""Job queues: create, describe, update, delete, and GetJobQueueSnapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import select

from orchestrator.api.batch import fargate, validation
from orchestrator.api.batch.paging import page
from orchestrator.api.batch.tags import check_engine_tags
from orchestrator.api.batch.value_checks import check_choice, check_name, check_range, check_tags
from orchestrator.control.compute_environments import environments_of
from orchestrator.control.snapshot import open_attempts
from orchestrator.control.usage import utilization
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import ComputeEnvironment, JobQueue, SchedulingPolicy, now
from orchestrator.services.arns import compute_environment_arn, job_arn, plain_name, policy_arn, queue_arn
from orchestrator.services.context import Context
from orchestrator.services.permissions import JobsOf, Operation, Shared

_MOST_COMPUTE_ENVIRONMENTS, _MOST_QUEUES = 3, 50
_REASONS = (
    "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY",
    "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE",
    "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT",
)


def create_job_queue(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """CreateJobQueue."""
    name = request["jobQueueName"]
    check_name("jobQueueName", name)
    check_tags(request.get("tags") or {})
    context.actor.check(Operation.CREATE_JOB_QUEUE, Shared())
    if context.session.get(JobQueue, name):
        raise ClientError(f"Job queue {name} exists already; change it with: aws batch update-job-queue")
    if len(context.session.scalars(select(JobQueue.name)).all()) >= _MOST_QUEUES:
        raise ClientError(f"there are {_MOST_QUEUES} job queues; delete one first")
    _check_kind(request)
    if not request.get("computeEnvironmentOrder"):
        raise ClientError("computeEnvironmentOrder is missing: name 1 to 3 compute environments")
    queue = JobQueue(name=name, compute_environments=[], limits=[], tags=request.get("tags") or {})
    _apply(context, queue, request)
    if (kind := request.get("jobQueueType")) not in (None, own := _type(context, queue)):
        raise ClientError(
            f"jobQueueType is {kind}, and the compute environments make it {own}: use that, or leave it out"
        )
    check_engine_tags(context, queue, queue.tags)
    if policy := request.get("schedulingPolicyArn"):
        queue.policy = context.named(SchedulingPolicy, policy).name
    context.session.add(queue)
    return {"jobQueueName": name, "jobQueueArn": queue_arn(name)}


def describe_job_queues(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeJobQueues, by names or ARNs, or all."""
    query = select(JobQueue).order_by(JobQueue.name)
    if named := request.get("jobQueues"):
        query = query.where(JobQueue.name.in_([plain_name(each, "job-queue") for each in named]))
    rows, token = page(context.session, query, request, JobQueue.name)
    return {"jobQueues": [_describe(context, queue) for queue in rows], **token}


def update_job_queue(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """UpdateJobQueue; a scheduling policy can be replaced, but neither added nor removed, as on AWS."""
    queue = context.queue(request["jobQueue"])
    context.actor.check(Operation.UPDATE_JOB_QUEUE, queue)
    if (policy := request.get("schedulingPolicyArn")) is not None:
        if queue.policy is None:
            raise ClientError(
                f"Job queue {queue.name} is first in, first out; a scheduling policy can't be added to it"
            )
        queue.policy = context.named(SchedulingPolicy, policy).name
    _check_kind(request)
    _apply(context, queue, request)
    return {"jobQueueName": queue.name, "jobQueueArn": queue_arn(queue.name)}


def delete_job_queue(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DeleteJobQueue of a queue that is DISABLED: its jobs are ended, and with the last one it is gone."""
    context.actor.check(Operation.DELETE_JOB_QUEUE, Shared())
    queue = context.session.get(JobQueue, plain_name(request["jobQueue"], "job-queue"))
    if queue is None or queue.deleting:
        return {}
    if queue.state != "DISABLED":
        raise ClientError(f"Job queue {queue.name} is ENABLED; disable it first: UpdateJobQueue with state DISABLED")
    queue.deleting = True
    context.controller.upkeep.drain(context.session, queue)
    return {}


def get_job_queue_snapshot(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """GetJobQueueSnapshot: the first 100 RUNNABLE jobs in the order in which they will be started, and the resources in use."""
    queue = context.queue(request["jobQueue"], deleting=True)
    context.actor.check(Operation.GET_JOB_QUEUE_SNAPSHOT, JobsOf(queue.name))
    order, times = context.controller.admission.front(queue.name, 100)
    jobs = [{"jobArn": job_arn(job), "earliestTimeAtPosition": times.get(job, now())} for job in order]
    return {
        "frontOfQueue": {"jobs": jobs, "lastUpdatedAt": now()},
        "queueUtilization": _utilization(context, queue),
    }


def _utilization(context: Context, queue: JobQueue) -> dict[str, Any]:
    used, by_share = utilization(open_attempts(context.session, context.controller.work_queue.active()), queue.name)
    detail: dict[str, Any] = {
        "totalCapacityUsage": [{"capacityUnit": unit, "quantity": amount} for unit, amount in used.items()],
        "lastUpdatedAt": now(),
    }
    if queue.policy is not None:
        usage = [
            {
                "shareIdentifier": share,
                "capacityUsage": [{"capacityUnit": unit, "quantity": amount} for unit, amount in amounts.items()],
            }
            for share, amounts in sorted(by_share.items())
        ]
        detail["fairshareUtilization"] = {"activeShareCount": len(usage), "topCapacityUtilization": usage[:20]}
    return detail


def _apply(context: Context, queue: JobQueue, request: Mapping[str, Any]) -> None:
    """The part shared by CreateJobQueue and UpdateJobQueue."""
    if (state := request.get("state")) is not None:
        check_choice("state", state, "ENABLED", "DISABLED")
        queue.state = state
    if (priority := request.get("priority")) is not None:
        check_range("priority", priority, 0, 1_000_000)
        queue.priority = priority
    if order := request.get("computeEnvironmentOrder"):
        queue.sent_order = _checked_order(context, order)
        queue.compute_environments = [
            each["computeEnvironment"] for each in sorted(queue.sent_order, key=lambda each: each["order"])
        ]
    if (limits := request.get("jobStateTimeLimitActions")) is not None:
        queue.limits = _limits(limits)


def _check_kind(request: Mapping[str, Any]) -> None:
    if request.get("serviceEnvironmentOrder"):
        raise ClientError("serviceEnvironmentOrder is not supported; use computeEnvironmentOrder")
    if (kind := request.get("jobQueueType")) == "EKS":
        raise ClientError(f"jobQueueType EKS {validation.NO_KUBERNETES} use ECS or ECS_FARGATE")
    if kind not in (None, "ECS", "ECS_FARGATE"):
        raise ClientError(f"jobQueueType {kind[:50]!r} is not supported; use ECS or ECS_FARGATE")


def _type(context: Context, queue: JobQueue) -> str:
    """``jobQueueType``, which follows from the compute environments."""
    documents = [each.document for each in environments_of(context.session, queue)]
    return "ECS_FARGATE" if fargate.of_queue(documents) else "ECS"


def _checked_order(context: Context, order: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """``computeEnvironmentOrder`` as it was sent, with names for ARNs. Raises ClientError."""
    if len(order) > _MOST_COMPUTE_ENVIRONMENTS:
        raise ClientError(
            f"computeEnvironmentOrder has {len(order)} entries; a queue has at most {_MOST_COMPUTE_ENVIRONMENTS}"
        )
    for each in order:
        check_range("computeEnvironmentOrder order", each["order"], 0, 2**31 - 1)
    names = [plain_name(each["computeEnvironment"], "compute-environment") for each in order]
    if len(set(names)) != len(names) or len({each["order"] for each in order}) != len(order):
        raise ClientError("computeEnvironmentOrder: every compute environment and every order once")
    if len({fargate.of_environment(context.named(ComputeEnvironment, name).document) for name in names}) > 1:
        raise ClientError("computeEnvironmentOrder: compute environments of EC2 and of Fargate can't be mixed")
    return [{"order": each["order"], "computeEnvironment": name} for each, name in zip(order, names, strict=True)]


def _limits(limits: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    for limit in limits:
        if limit["reason"] not in _REASONS:
            raise ClientError(
                f"jobStateTimeLimitActions reason {limit['reason'][:100]!r}: it is {' or '.join(_REASONS)}"
            )
        check_range("jobStateTimeLimitActions maxTimeSeconds", limit["maxTimeSeconds"], 600, 86400)
        if limit["state"] != "RUNNABLE" or limit["action"] != "CANCEL":
            raise ClientError("jobStateTimeLimitActions: the state is RUNNABLE and the action CANCEL")
    return [dict(limit) for limit in limits]


def _describe(context: Context, queue: JobQueue) -> dict[str, Any]:
    sent = queue.sent_order or [
        {"order": number, "computeEnvironment": name} for number, name in enumerate(queue.compute_environments, 1)
    ]
    order = [{**each, "computeEnvironment": compute_environment_arn(each["computeEnvironment"])} for each in sent]
    return {
        "jobQueueName": queue.name,
        "jobQueueArn": queue_arn(queue.name),
        "state": queue.state,
        "status": "DELETING" if queue.deleting else "VALID",
        "statusReason": "its jobs are being ended" if queue.deleting else "JobQueue Healthy",
        "priority": queue.priority,
        "computeEnvironmentOrder": order,
        "jobStateTimeLimitActions": queue.limits,
        "jobQueueType": _type(context, queue),
        "tags": queue.tags,
        **({"schedulingPolicyArn": policy_arn(queue.policy)} if queue.policy else {}),
    }
