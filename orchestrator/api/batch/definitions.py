"""Job definitions: register, describe, deregister."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select

from orchestrator.api.arns import definition_arn, plain_name
from orchestrator.api.batch import fargate, rules
from orchestrator.api.batch.describe import ecs_with_defaults, node_ranges, retry_strategy, with_defaults
from orchestrator.api.batch.paging import page, page_size
from orchestrator.api.context import Context
from orchestrator.api.kept_texts import check_texts
from orchestrator.domain.gang import GangSpec
from orchestrator.persistence.models import JobDefinition
from orchestrator.services import permissions
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Actor, Operation

_PROPERTIES = ("nodeProperties", "containerProperties", "ecsProperties")


def register_job_definition(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """RegisterJobDefinition; each registration of a name is a new revision."""
    return register(context, request)[0]


def register(context: Context, request: dict[str, Any]) -> tuple[dict[str, Any], GangSpec]:
    """RegisterJobDefinition: its answer, and the gang of the definition. Raises ClientError."""
    name, kind = request["jobDefinitionName"], request["type"]
    rules.check_name("jobDefinitionName", name)
    rules.check_tries(request)
    rules.check_tags(request.get("tags") or {})
    rules.check_priority("schedulingPriority", request.get("schedulingPriority"))
    wanted = {"multinode": ["nodeProperties"], "container": ["containerProperties", "ecsProperties"]}.get(kind)
    if wanted is None:
        raise ClientError(f"job definition {name}: type {kind[:50]!r} is not supported; it is multinode or container")
    if request.get("eksProperties"):
        raise ClientError(f"job definition {name}: eksProperties {rules.NO_KUBERNETES} use {' or '.join(wanted)}")
    given = [key for key in _PROPERTIES if request.get(key)]
    if len(given) != 1 or given[0] not in wanted:
        raise ClientError(f"job definition {name}: type {kind} needs {' or '.join(wanted)}, and only that")
    properties = rules.node_properties(request)
    gang = rules.check_nodes(properties, kind)
    fargate.check_platform(request, properties, f"job definition {name}")
    _check_owner(context, name, Operation.REGISTER_JOB_DEFINITION)
    check_texts(context, gang)
    query = select(JobDefinition.revision, JobDefinition.owner).where(JobDefinition.name == name)
    newest = context.session.execute(query.order_by(JobDefinition.revision.desc()).limit(1)).first()
    revision = newest.revision + 1 if newest else 1
    # the name stays its owner's when a key with all queues adds a revision
    owner = (newest.owner if newest else None) or context.actor.name
    document = {key: value for key, value in request.items() if key != "tags"}
    context.session.add(
        JobDefinition(name=name, revision=revision, document=document, owner=owner, tags=request.get("tags") or {})
    )
    answer = {"jobDefinitionName": name, "jobDefinitionArn": definition_arn(name, revision), "revision": revision}
    return answer, gang


def describe_job_definitions(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeJobDefinitions by names or ARNs, by name and status, or all; the newest revision first."""
    listed = request.get("jobDefinitions") or []
    query = select(JobDefinition).order_by(JobDefinition.name, JobDefinition.revision.desc())
    if listed:
        wanted = [plain_name(each, "job-definition").partition(":") for each in listed]
        found = [
            each
            for each in context.session.scalars(query.where(JobDefinition.name.in_([name for name, _, _ in wanted])))
            if any(each.name == name and revision in ("", str(each.revision)) for name, _, revision in wanted)
            and request.get("status") in (None, each.status)
        ]
        return {"jobDefinitions": [_describe(context.actor, each) for each in found]}
    if name := request.get("jobDefinitionName"):
        query = query.where(JobDefinition.name == plain_name(name, "job-definition").partition(":")[0])
    if status := request.get("status"):
        query = query.where(JobDefinition.status == status)
    found_page, token = page(
        context.session, query, request, page_size(request, 100), (JobDefinition.name, JobDefinition.revision)
    )
    return {"jobDefinitions": [_describe(context.actor, each) for each in found_page], **token}


def deregister_job_definition(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """DeregisterJobDefinition: INACTIVE; jobs that were submitted with it continue."""
    name, _, revision = plain_name(request["jobDefinition"], "job-definition").partition(":")
    if not (revision.isascii() and revision.isdigit() and len(revision) < 10):
        raise ClientError(
            f"job definition {request['jobDefinition'][:300]!r}: name it with its revision, NAME:N, or by ARN"
        )
    _check_owner(context, name, Operation.DEREGISTER_JOB_DEFINITION)
    definition = context.session.get(JobDefinition, (name, int(revision)))
    if definition is not None:  # AWS answers the same for one that is not there
        definition.status = "INACTIVE"
    return {}


def _check_owner(context: Context, name: str, operation: Operation) -> None:
    """Refuse a name that another key has registered: jobs are submitted by the bare name."""
    caller = context.actor.name
    foreign = select(JobDefinition).where(JobDefinition.name == name, JobDefinition.owner.is_distinct_from(caller))
    context.actor.check(operation, *context.session.scalars(foreign.limit(1)))


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
