"""Job definitions: register, describe, deregister."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select

from orchestrator.api.batch import fargate, validation
from orchestrator.api.batch.descriptions import ecs_with_defaults, node_ranges, retry_strategy, with_defaults
from orchestrator.api.batch.paging import page
from orchestrator.api.batch.value_checks import check_name, check_range, check_tags
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import JobDefinition
from orchestrator.services import permissions
from orchestrator.services.arns import definition_arn, plain_name
from orchestrator.services.context import Context
from orchestrator.services.permissions import Actor, Operation
from orchestrator.services.submission import revision

_PROPERTIES = ("nodeProperties", "containerProperties", "ecsProperties")


def register_job_definition(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """RegisterJobDefinition; each registration of a name is a new revision."""
    name, kind = request["jobDefinitionName"], request["type"]
    check_name("jobDefinitionName", name)
    validation.check_tries(request)
    check_tags(request.get("tags") or {})
    check_range("schedulingPriority", request.get("schedulingPriority"), 0, 9999)
    allowed = {"multinode": ["nodeProperties"], "container": ["containerProperties", "ecsProperties"]}.get(kind)
    if allowed is None:
        raise ClientError(f"job definition {name}: type {kind[:50]!r} is not supported; it is multinode or container")
    if request.get("eksProperties"):
        raise ClientError(f"job definition {name}: eksProperties {validation.NO_KUBERNETES} use {' or '.join(allowed)}")
    present = [key for key in _PROPERTIES if request.get(key)]
    if len(present) != 1 or present[0] not in allowed:
        raise ClientError(f"job definition {name}: type {kind} needs {' or '.join(allowed)}, and only that")
    properties = validation.node_properties(request)
    gang = validation.check_nodes(properties, kind)
    fargate.check_platform(request, properties, f"job definition {name}")
    document = {key: value for key, value in request.items() if key != "tags"}
    added = revision(context, name, document, gang, request.get("tags"))
    context.session.add(added)
    arn = definition_arn(name, added.revision)
    return {"jobDefinitionName": name, "jobDefinitionArn": arn, "revision": added.revision}


def describe_job_definitions(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeJobDefinitions by names or ARNs, by name and status, or all; the newest revision first."""
    listed = request.get("jobDefinitions") or []
    query = select(JobDefinition).order_by(JobDefinition.name, JobDefinition.revision.desc())
    if listed:
        allowed = [plain_name(each, "job-definition").partition(":") for each in listed]
        found = [
            each
            for each in context.session.scalars(query.where(JobDefinition.name.in_([name for name, _, _ in allowed])))
            if any(each.name == name and revision in ("", str(each.revision)) for name, _, revision in allowed)
            and request.get("status") in (None, each.status)
        ]
        return {"jobDefinitions": [_describe(context.actor, each) for each in found]}
    if name := request.get("jobDefinitionName"):
        query = query.where(JobDefinition.name == plain_name(name, "job-definition").partition(":")[0])
    if status := request.get("status"):
        query = query.where(JobDefinition.status == status)
    keys = JobDefinition.name, JobDefinition.revision
    found_page, token = page(context.session, query, request, *keys, descending=(False, True))
    return {"jobDefinitions": [_describe(context.actor, each) for each in found_page], **token}


def deregister_job_definition(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DeregisterJobDefinition: INACTIVE; jobs that were submitted with it continue."""
    name, _, revision = plain_name(request["jobDefinition"], "job-definition").partition(":")
    if not (revision.isascii() and revision.isdigit() and len(revision) < 10):
        raise ClientError(
            f"job definition {request['jobDefinition'][:300]!r}: name it with its revision, NAME:N, or by ARN"
        )
    definition = context.session.get(JobDefinition, (name, int(revision)))
    if definition is not None:  # AWS answers the same for one that is not there
        context.actor.check(Operation.DEREGISTER_JOB_DEFINITION, definition)
        definition.status = "INACTIVE"
    return {}


def _describe(actor: Actor, definition: JobDefinition) -> dict[str, Any]:
    document = definition.document
    if not actor.may_see(definition):
        document = permissions.without_values(document)
    shown = {
        "containerOrchestrationType": "ECS",
        "platformCapabilities": ["EC2"],
        "parameters": {},
        **document,
        "jobDefinitionArn": definition_arn(definition.name, definition.revision),
        "revision": definition.revision,
        "status": definition.status,
        "tags": definition.tags,
    }
    if document.get("retryStrategy"):
        shown["retryStrategy"] = retry_strategy(document["retryStrategy"])
    if document.get("containerProperties"):
        shown["containerProperties"] = with_defaults(document["containerProperties"], document)
    if document.get("ecsProperties"):
        shown["ecsProperties"] = ecs_with_defaults(document["ecsProperties"])
    if document.get("nodeProperties"):
        shown["nodeProperties"] = node_ranges(document["nodeProperties"])
    return shown
