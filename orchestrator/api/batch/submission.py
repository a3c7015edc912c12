"""SubmitJob: multi-node jobs, single-node jobs, arrays of them, and their dependencies, in AWS's shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from orchestrator.api.batch import fargate, validation
from orchestrator.api.batch.members import check_consumables
from orchestrator.api.batch.value_checks import check_name, check_tags
from orchestrator.control.compute_environments import environments_of
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import Job
from orchestrator.services.arns import split_reference
from orchestrator.services.context import Context
from orchestrator.services.permissions import Operation
from orchestrator.services.submission import ShareRefused, Submission, Wait, answer, answered, open_queue, submit

_MOST_DEPENDENCIES = 20
_ARRAY_SIZES = range(2, 10_001)


def submit_job(context: Context, request: dict[str, Any]) -> dict[str, Any]:
    """SubmitJob. With an idempotency key a second call gets the answer of the first one."""
    request = {key: value for key, value in request.items() if value not in ({}, [])}  # Luigi sends what it has not set
    job = answered(context, request) or submit(context, _submission(context, request))
    return answer(job)


def _submission(context: Context, request: Mapping[str, Any]) -> Submission:
    """The request as it is meant. Raises ClientError."""
    check_name("jobName", request["jobName"])
    validation.check_tries(request)
    check_tags(request.get("tags") or {})
    queue, override = context.queue(request["jobQueue"]), request.get("schedulingPriorityOverride")
    try:
        share = open_queue(context, queue, request.get("shareIdentifier"), override)
    except ShareRefused as error:
        raise ClientError(error.aws) from None
    definition = context.definition(request["jobDefinition"])
    context.actor.check(Operation.SUBMIT_JOB, definition)
    document = definition.document
    parameters = {**(document.get("parameters") or {}), **(request.get("parameters") or {})}
    properties = validation.substitute(_properties(document, request), parameters)
    gang = validation.check_nodes(properties, document["type"])
    fargate.check_platform(document, properties, f"job definition {definition.name}")
    fargate.check_queue(queue.name, [each.document for each in environments_of(context.session, queue)], document)
    retry = request.get("retryStrategy") or document.get("retryStrategy") or {}
    timeout = request.get("timeout") or document.get("timeout") or {}
    size = request["arrayProperties"].get("size", 0) if request.get("arrayProperties") else None
    if size is not None and size not in _ARRAY_SIZES:
        raise ClientError(f"arrayProperties size is {size}; it must be 2 to 10000")
    return Submission(
        name=request["jobName"],
        queue=queue,
        definition=definition,
        properties=properties,
        gang=gang,
        record=request,
        share=share,
        priority=document.get("schedulingPriority", 0) if override is None else override,
        attempts=int(retry.get("attempts", 1)),
        evaluate_on_exit=retry.get("evaluateOnExit") or [],
        timeout=timeout.get("attemptDurationSeconds"),
        parameters=parameters,
        tags=request.get("tags"),
        waits=_waits(context, request, size),
        array=size,
    )


def _properties(document: Mapping[str, Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """The job's node properties, with the overrides that fit its type."""
    properties = validation.node_properties(document)
    if document["type"] == "multinode":
        check_consumables(request, "the job")
        for key in ("containerOverrides", "ecsPropertiesOverride", "eksPropertiesOverride"):
            if request.get(key):
                raise ClientError(f"{key} is not for a multi-node parallel job; use nodeOverrides")
        if request.get("arrayProperties"):
            raise ClientError("arrayProperties is not for a multi-node parallel job; submit the jobs one by one")
        return validation.override_nodes(properties, request.get("nodeOverrides") or {})
    if request.get("nodeOverrides"):
        raise ClientError("nodeOverrides is for multi-node parallel jobs; use containerOverrides")
    validation.override_range(properties["nodeRangeProperties"][0], request, "container")
    return properties


def _waits(context: Context, request: Mapping[str, Any], size: int | None) -> Sequence[Wait]:
    """``dependsOn``, checked; ``size`` of the array that waits, None for another job."""
    dependencies = request.get("dependsOn") or []
    if len(dependencies) > _MOST_DEPENDENCIES:
        raise ClientError(f"dependsOn has {len(dependencies)} entries; at most {_MOST_DEPENDENCIES}")
    found: dict[str, Wait] = {}
    for entry in dependencies:
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
            found[""] = Wait("", kind)
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
        found[on_id] = Wait(on_id, kind if kind == "N_TO_N" else None)
    return list(found.values())
