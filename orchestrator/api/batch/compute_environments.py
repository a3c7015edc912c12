"""Compute environments (hosts of an engine, by a name) and scheduling policies."""

from __future__ import annotations

import re
import uuid
from collections.abc import Mapping
from itertools import combinations
from typing import Any

from sqlalchemy import select

from orchestrator.api.batch import fargate, validation
from orchestrator.api.batch.paging import page
from orchestrator.api.batch.tags import check_engine_tags
from orchestrator.api.batch.value_checks import check_choice, check_name, check_range, check_tags
from orchestrator.control.compute_environments import is_built_in
from orchestrator.domain.errors import ClientError
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.batch_models import ComputeEnvironment, JobQueue, SchedulingPolicy
from orchestrator.services.arns import compute_environment_arn, ecs_arn, iam_arn, plain_name, policy_arn
from orchestrator.services.context import Context
from orchestrator.services.permissions import Operation, Shared

_MOST_COMPUTE_ENVIRONMENTS = 50
_SERVICE_ROLE = "/aws-service-role/batch.amazonaws.com/AWSServiceRoleForBatch"


def create_compute_environment(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """CreateComputeEnvironment. Subnets, instance types and the like are kept and shown, and mean nothing to the engine."""
    context.actor.check(Operation.CREATE_COMPUTE_ENVIRONMENT, Shared())
    name = request["computeEnvironmentName"]
    check_name("computeEnvironmentName", name)
    check_tags(request.get("tags") or {})
    if context.session.get(ComputeEnvironment, name):
        raise ClientError(f"Compute environment {name} exists already; UpdateComputeEnvironment changes it")
    if len(context.session.scalars(select(ComputeEnvironment.name)).all()) >= _MOST_COMPUTE_ENVIRONMENTS:
        raise ClientError(f"there are {_MOST_COMPUTE_ENVIRONMENTS} compute environments; delete one first")
    check_choice("type", request["type"], "MANAGED", "UNMANAGED")
    _check_members(request)
    resources = request.get("computeResources")
    if request["type"] == "MANAGED" and not resources:
        raise ClientError("a MANAGED compute environment needs computeResources")
    _check_resources(resources or {})
    document = {key: value for key, value in request.items() if key not in ("tags", "state")}
    compute_environment = ComputeEnvironment(name=name, document=document, tags=request.get("tags") or {})
    compute_environment.state = request.get("state", "ENABLED")
    check_choice("state", compute_environment.state, "ENABLED", "DISABLED")
    check_engine_tags(context, compute_environment, compute_environment.tags)
    context.session.add(compute_environment)
    return {"computeEnvironmentName": name, "computeEnvironmentArn": compute_environment_arn(name)}


def describe_compute_environments(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeComputeEnvironments, by names or ARNs, or all."""
    query = select(ComputeEnvironment).order_by(ComputeEnvironment.name)
    if named := request.get("computeEnvironments"):
        query = query.where(ComputeEnvironment.name.in_([plain_name(each, "compute-environment") for each in named]))
    rows, token = page(context.session, query, request, ComputeEnvironment.name)
    return {"computeEnvironments": [_describe(context, compute_environment) for compute_environment in rows], **token}


def update_compute_environment(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """UpdateComputeEnvironment: state and resources; running jobs are left alone."""
    compute_environment = context.named(ComputeEnvironment, request["computeEnvironment"])
    context.actor.check(Operation.UPDATE_COMPUTE_ENVIRONMENT, compute_environment)
    _check_members(request)
    if (state := request.get("state")) is not None:
        check_choice("state", state, "ENABLED", "DISABLED")
        compute_environment.state = state
    if changes := request.get("computeResources"):
        if compute_environment.document["type"] != "MANAGED":
            raise ClientError(
                f"Compute environment {compute_environment.name} is UNMANAGED and has no computeResources"
            )
        resources = {**(compute_environment.document.get("computeResources") or {}), **changes}
        _check_resources(resources)
        document = {**compute_environment.document, "computeResources": resources}
        is_moved = fargate.of_environment(document) != fargate.of_environment(compute_environment.document)
        if is_moved and (queue := _queue_of(context, compute_environment)):
            raise ClientError(
                f"computeResources type {resources['type']}: compute environment {compute_environment.name} is used by job queue "
                f"{queue} and can't change between EC2 and Fargate; give that queue another compute environment first"
            )
        compute_environment.document = document
    for key in ("serviceRole", "unmanagedvCpus", "updatePolicy", "context", "ecsSettings"):
        if key in request:
            compute_environment.document = {**compute_environment.document, key: request[key]}
    return {
        "computeEnvironmentName": compute_environment.name,
        "computeEnvironmentArn": compute_environment_arn(compute_environment.name),
    }


def delete_compute_environment(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DeleteComputeEnvironment of one that is DISABLED and in no queue."""
    context.actor.check(Operation.DELETE_COMPUTE_ENVIRONMENT, Shared())
    compute_environment = context.session.get(
        ComputeEnvironment, plain_name(request["computeEnvironment"], "compute-environment")
    )
    if compute_environment is None:
        return {}
    if compute_environment.state != "DISABLED":
        raise ClientError(f"Compute environment {compute_environment.name} is ENABLED; disable it first")
    if queue := _queue_of(context, compute_environment):
        raise ClientError(
            f"Compute environment {compute_environment.name} is used by job queue {queue}; delete that first"
        )
    context.session.delete(compute_environment)
    return {}


def create_scheduling_policy(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """CreateSchedulingPolicy with a fairsharePolicy."""
    context.actor.check(Operation.CREATE_SCHEDULING_POLICY, Shared())
    name = request["name"]
    check_name("name", name)
    check_tags(request.get("tags") or {})
    if request.get("quotaSharePolicy"):
        raise ClientError("quotaSharePolicy is for service jobs, which are not supported; use fairsharePolicy")
    if context.session.get(SchedulingPolicy, name):
        raise ClientError(f"Scheduling policy {name} exists already; UpdateSchedulingPolicy changes it")
    fairshare = request.get("fairsharePolicy")
    if fairshare is None:
        raise ClientError(f"Scheduling policy {name}: give a fairsharePolicy; {{}} is one with the defaults")
    _check_fairshare(fairshare)
    context.session.add(SchedulingPolicy(name=name, fairshare=fairshare, tags=request.get("tags") or {}))
    return {"name": name, "arn": policy_arn(name)}


def describe_scheduling_policies(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeSchedulingPolicies by ARNs; unknown ones are passed over."""
    found = [context.session.get(SchedulingPolicy, plain_name(arn, "scheduling-policy")) for arn in request["arns"]]
    return {
        "schedulingPolicies": [
            {"name": each.name, "arn": policy_arn(each.name), "fairsharePolicy": each.fairshare, "tags": each.tags}
            for each in found
            if each is not None
        ]
    }


def list_scheduling_policies(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """ListSchedulingPolicies."""
    query = select(SchedulingPolicy).order_by(SchedulingPolicy.name)
    rows, token = page(context.session, query, request, SchedulingPolicy.name)
    return {"schedulingPolicies": [{"arn": policy_arn(policy.name)} for policy in rows], **token}


def update_scheduling_policy(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """UpdateSchedulingPolicy: the fairsharePolicy is replaced."""
    policy = context.named(SchedulingPolicy, request["arn"])
    context.actor.check(Operation.UPDATE_SCHEDULING_POLICY, policy)
    if request.get("quotaSharePolicy"):
        raise ClientError(f"Scheduling policy {policy.name} has a fairsharePolicy; its kind can't change")
    if (fairshare := request.get("fairsharePolicy")) is not None:
        _check_fairshare(fairshare)
        policy.fairshare = fairshare
    return {}


def delete_scheduling_policy(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DeleteSchedulingPolicy of one that no queue uses."""
    policy = context.named(SchedulingPolicy, request["arn"])
    context.actor.check(Operation.DELETE_SCHEDULING_POLICY, policy)
    user = context.session.scalars(select(JobQueue).where(JobQueue.policy == policy.name).limit(1)).first()
    if user is not None:
        raise ClientError(f"Scheduling policy {policy.name} is used by job queue {user.name}; delete that first")
    context.session.delete(policy)
    return {}


def _queue_of(context: Context, compute_environment: ComputeEnvironment) -> str | None:
    """The name of a queue with this compute environment; None where there is none."""
    queues = context.session.scalars(select(JobQueue))
    return next((each.name for each in queues if compute_environment.name in each.compute_environments), None)


def _check_members(request: Mapping[str, Any]) -> None:
    """CreateComputeEnvironment and UpdateComputeEnvironment: refuse members of EKS by name. Raises ClientError."""
    resources = request.get("computeResources") or {}
    images, template = resources.get("ec2Configuration") or [], resources.get("launchTemplate") or {}
    templates = [template, *(template.get("overrides") or [])]
    of_eks = [
        *(["eksConfiguration"] if request.get("eksConfiguration") else []),
        *(
            f"ec2Configuration imageType {kind[:50]}"
            for each in images
            if (kind := each["imageType"]).startswith("EKS")
        ),
        *("ec2Configuration imageKubernetesVersion" for each in images if each.get("imageKubernetesVersion")),
        *(f"launchTemplate userdataType {kind[:50]}" for each in templates if (kind := each.get("userdataType"))),
    ]
    if of_eks:
        raise ClientError(f"{of_eks[0]} {validation.NO_KUBERNETES} leave it out")
    insights = (request.get("ecsSettings") or {}).get("containerInsights") or "DISABLED"
    check_choice("containerInsights", insights, "ENABLED", "ENHANCED", "DISABLED")


def _check_resources(resources: Mapping[str, Any]) -> None:
    fargate.check_resources(resources)
    for key in ("minvCpus", "maxvCpus", "desiredvCpus"):
        check_range(f"computeResources {key}", resources.get(key), 0, 10_000_000)


def _check_fairshare(fairshare: Mapping[str, Any]) -> None:
    check_range("shareDecaySeconds", fairshare.get("shareDecaySeconds"), 0, 604_800)
    check_range("computeReservation", fairshare.get("computeReservation"), 0, 99)
    shares = fairshare.get("shareDistribution") or []
    if len(shares) > 500:
        raise ClientError(f"shareDistribution has {len(shares)} entries; at most 500")
    names = [each["shareIdentifier"] for each in shares]
    for each in shares:
        if not re.fullmatch(r"[A-Za-z0-9]{0,254}([A-Za-z0-9]|\*)", each["shareIdentifier"]):
            raise ClientError(
                f"shareIdentifier {each['shareIdentifier'][:100]!r}: 1 to 255 letters and digits, a * at the end at most"
            )
        check_range("weightFactor", each.get("weightFactor"), 0.0001, 999.9999)
    for other, name in combinations(names, 2):
        if _matches(name, other) or _matches(other, name):
            raise ClientError(f"shareDistribution: {other} and {name} overlap")


def _matches(pattern: str, name: str) -> bool:
    """Whether an entry (a name, or a prefix and ``*``) covers a name."""
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def _describe(context: Context, compute_environment: ComputeEnvironment) -> dict[str, Any]:
    document: dict[str, Any] = {
        "containerOrchestrationType": "ECS",
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_OID, f"{compute_environment.name}/{compute_environment.created_at}")),
        "ecsClusterArn": ecs_arn("cluster", compute_environment.name),
        **compute_environment.document,
        "computeEnvironmentName": compute_environment.name,
        "computeEnvironmentArn": compute_environment_arn(compute_environment.name),
        "state": compute_environment.state,
        "status": "VALID",
        "statusReason": "ComputeEnvironment Healthy",
        "tags": compute_environment.tags,
    }
    if document["type"] == "MANAGED":
        document.setdefault("serviceRole", iam_arn(f"role{_SERVICE_ROLE}"))
        policy = {"terminateJobsOnUpdate": False, "jobExecutionTimeoutMinutes": 30}
        document["updatePolicy"] = {**policy, **document.get("updatePolicy", {})}
    if is_built_in(compute_environment):
        document["computeResources"] = {
            **_own_resources(context, compute_environment),
            **document.get("computeResources", {}),
        }
    return document


def _own_resources(context: Context, compute_environment: ComputeEnvironment) -> dict[str, Any]:
    """``computeResources`` of a built-in compute environment: the hosts that its engine has now."""
    engine = context.controller.engines
    served = [compute_environment.name] if compute_environment.name in engine.names else []
    cpus = int(sum(host.cpus for each in engine.capacity(served, FRESH).values() for host in each.places))
    return {
        "type": "EC2",
        "allocationStrategy": "BEST_FIT_PROGRESSIVE",
        "minvCpus": 0 if engine.is_elastic(served) else cpus,
        "maxvCpus": cpus,
        "desiredvCpus": cpus,
        "instanceTypes": ["optimal"],
        "subnets": [],
        "securityGroupIds": [],
        "instanceRole": iam_arn("instance-profile/muster"),
        "tags": {},
    }
