"""Tags: TagResource, UntagResource, ListTagsForResource; and what tags ``muster:…`` may say of engines and of retention."""

from __future__ import annotations

from typing import Any

from orchestrator.api.batch.value_checks import check_tags
from orchestrator.control.compute_environments import ENGINE_TAG, engine_named_by, environments_of
from orchestrator.domain.errors import ClientError
from orchestrator.domain.retention import TAG, rule_of
from orchestrator.engines.api import EngineError
from orchestrator.engines.installed import ENGINES
from orchestrator.engines.installed import check_tags as check_options
from orchestrator.persistence.batch_models import ComputeEnvironment, Job, JobDefinition, JobQueue, SchedulingPolicy
from orchestrator.services.arns import split_arn
from orchestrator.services.context import Context
from orchestrator.services.permissions import Operation
from shared_store.contract.error_text import nearest

_TABLES = {
    "job": Job,
    "job-queue": JobQueue,
    "compute-environment": ComputeEnvironment,
    "scheduling-policy": SchedulingPolicy,
}


def tag_resource(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """Add tags, or replace their values."""
    resource = _resource(context, request["resourceArn"], Operation.TAG_RESOURCE)
    tags = {**resource.tags, **request["tags"]}
    check_tags(tags)
    check_engine_tags(context, resource, tags)
    resource.tags = tags
    return {}


def untag_resource(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """Remove tags; missing ones are passed over."""
    resource = _resource(context, request["resourceArn"], Operation.UNTAG_RESOURCE)
    resource.tags = {key: value for key, value in resource.tags.items() if key not in request["tagKeys"]}
    return {}


def list_tags_for_resource(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """The resource's tags."""
    return {"tags": _resource(context, request["resourceArn"], Operation.LIST_TAGS_FOR_RESOURCE).tags}


def _resource(context: Context, arn: str, operation: Operation) -> Any:
    """The resource, where the caller may do this to it. Raises ClientError."""
    resource = _find(context, arn)
    context.actor.check(operation, resource)
    return resource


def _find(context: Context, arn: str) -> Any:
    """The row that an ARN names; the nodes of a job and the children of an array have no tags of their own, as on AWS."""
    kind, name = split_arn(arn)
    found: Any
    if kind == "job-definition":
        name, _, revision = name.partition(":")
        is_number = revision.isascii() and revision.isdigit() and len(revision) < 10
        found = context.session.get(JobDefinition, (name, int(revision))) if is_number else None
    elif kind == "job" and ("#" in name or ":" in name):
        raise ClientError(f"{arn[:300]}: nodes and children have no tags of their own; tag the job")
    else:
        found = context.session.get(_TABLES[kind], name) if kind in _TABLES else None
    if found is None:
        raise ClientError(f"Resource {arn[:300]} does not exist")
    return found


def check_engine_tags(context: Context, resource: object, tags: dict[str, str]) -> None:
    """Raises ClientError where the resource can't have these tags, for an option that is misspelt or has a wrong value."""
    first = context.controller.engines.names[0]
    if isinstance(resource, ComputeEnvironment):
        engines = [engine_named_by(tags, first)]
    elif isinstance(resource, JobQueue):
        if (rule := tags.get(TAG)) is not None:
            tags = {tag: value for tag, value in tags.items() if tag != TAG}
            try:
                rule_of(rule)
            except ValueError as error:
                raise ClientError(f"tag {TAG}: {error}") from None
        engines = [engine_named_by(each.tags, first) for each in environments_of(context.session, resource)]
    else:
        return
    if not any(tag.startswith("muster:") for tag in tags):
        return
    if isinstance(resource, ComputeEnvironment) and engines[0] not in (*ENGINES, *context.controller.engines.names):
        raise ClientError(
            f"tag {ENGINE_TAG} is {engines[0][:100]!r}: there is no such engine; {nearest(engines[0], ENGINES)}"
        )
    try:
        check_options(tags, [each for each in engines if each in ENGINES], of_a_queue=isinstance(resource, JobQueue))
    except (ValueError, EngineError) as error:
        raise ClientError(str(error)) from None
