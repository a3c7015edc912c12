"""AWS Batch operations in AWS's own shapes: from a request to a response.

Requests are validated against the service model that botocore ships (data, not code of ours), then against the rules that the
model can't say.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from orchestrator.api.batch import compute_environments, definitions, jobs, queues, submission, tags
from orchestrator.api.batch.service_model import problem_with, service_model
from orchestrator.api.http import limits
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.services.context import Context, Known, with_store
from orchestrator.services.permissions import Actor, Operation
from orchestrator.services.sources import with_teacher
from shared_store.volume.initial_weights import TeacherCopy

OPERATIONS: dict[str, Callable[[Context, dict[str, Any]], dict[str, Any]]] = {
    "RegisterJobDefinition": definitions.register_job_definition,
    "DescribeJobDefinitions": definitions.describe_job_definitions,
    "DeregisterJobDefinition": definitions.deregister_job_definition,
    "SubmitJob": submission.submit_job,
    "DescribeJobs": jobs.describe_jobs,
    "ListJobs": jobs.list_jobs,
    "TerminateJob": jobs.terminate_job,
    "CancelJob": jobs.cancel_job,
    "TerminateJobs": jobs.terminate_jobs,
    "CancelJobs": jobs.cancel_jobs,
    "CreateJobQueue": queues.create_job_queue,
    "DescribeJobQueues": queues.describe_job_queues,
    "UpdateJobQueue": queues.update_job_queue,
    "DeleteJobQueue": queues.delete_job_queue,
    "GetJobQueueSnapshot": queues.get_job_queue_snapshot,
    "CreateComputeEnvironment": compute_environments.create_compute_environment,
    "DescribeComputeEnvironments": compute_environments.describe_compute_environments,
    "UpdateComputeEnvironment": compute_environments.update_compute_environment,
    "DeleteComputeEnvironment": compute_environments.delete_compute_environment,
    "CreateSchedulingPolicy": compute_environments.create_scheduling_policy,
    "DescribeSchedulingPolicies": compute_environments.describe_scheduling_policies,
    "ListSchedulingPolicies": compute_environments.list_scheduling_policies,
    "UpdateSchedulingPolicy": compute_environments.update_scheduling_policy,
    "DeleteSchedulingPolicy": compute_environments.delete_scheduling_policy,
    "TagResource": tags.tag_resource,
    "UntagResource": tags.untag_resource,
    "ListTagsForResource": tags.list_tags_for_resource,
}
_INSTEAD = {
    "ServiceJob": "SubmitJob with a job definition of type multinode or container",
    "ServiceEnvironment": "CreateComputeEnvironment",
    "QuotaShare": "CreateSchedulingPolicy with a fairsharePolicy",
    "ConsumableResource": "a job queue with its own compute environment, whose size limits what runs at once",
}
"""Substitutes for unsupported operations, by a part of their names."""


_ADDING = ("Submit", "Register", "Create", "Tag")
"""Prefixes of the operations that need space in the database; the others change or end existing objects."""


@cache
def operation_names() -> dict[str, str]:
    """Path name (lower case) → operation, of every operation that AWS Batch has."""
    return {name.lower(): name for name in service_model("batch").operation_names}


def validate(operation: str, request: object) -> dict[str, Any]:
    """The request, checked against AWS's model. Raises ClientError with what is wrong, in one line."""
    if not isinstance(request, dict):
        raise ClientError(f"{operation}: expected a JSON object")
    limits.check_size(operation, request)
    if problem := problem_with("batch", operation, request):
        raise ClientError(f"Error executing request, Exception : {problem[:2000]}")
    return request


def call(
    controller: Controller, actor: Actor, operation: str, request: object, idempotency_key: str | None = None
) -> dict[str, Any]:
    """Carry out one operation. Raises ClientError; DatabaseError where it writes and can't (:meth:`orchestrator.control.writes.Writes.check`)."""
    handler = OPERATIONS.get(operation)
    if handler is None:
        instead = next((use for part, use in _INSTEAD.items() if part in operation), None)
        known = operation in operation_names().values()
        hint = f"use {instead}" if instead else f"supported are {', '.join(OPERATIONS)}"
        raise ClientError(
            f"{operation[:100]} {'is not supported here' if known else 'is not an operation of AWS Batch'}; {hint}"
        )
    checked = validate(operation, request)
    permitted = Operation(operation)
    actor.check(permitted)
    if permitted.reads:
        with controller.database.session() as session:
            answer: dict[str, Any] = actor.shown(handler(Context(session, controller, actor), checked))
            return answer

    def carry_out(known: Known) -> dict[str, Any]:
        with controller.writes.session() as session:
            return handler(Context(session, controller, actor, idempotency_key, known=known), checked)

    def submit(teacher: TeacherCopy | None) -> dict[str, Any]:
        def call(known: Known) -> dict[str, Any]:
            def handle(session: Session) -> dict[str, Any]:
                return handler(
                    Context(session, controller, actor, idempotency_key, teacher=teacher, known=known), checked
                )

            return controller.writes.gather(handle)

        return with_store(controller, call)

    controller.writes.check(adds=operation.startswith(_ADDING))
    try:
        is_submission = operation == "SubmitJob"
        response = with_teacher(controller, submit) if is_submission else with_store(controller, carry_out)
    except IntegrityError as error:  # two calls at the same instant
        raise ClientError(f"{operation}: the database refuses it ({str(error.orig).splitlines()[0][:200]})") from None
    controller.work_queue.alarm.set()
    return response
