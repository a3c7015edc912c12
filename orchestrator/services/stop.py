"""Stopping jobs: at the request of an actor, with a reason that stays with the job."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import or_

from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.excerpts import LONGEST_REASON
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.queries import ask_to_end
from orchestrator.services.context import Context
from orchestrator.services.permissions import Actor, Operation


class UnknownJob(ClientError):
    """No job has this id."""


def end(context: Context, job_id: str, reason: str, operation: Operation, *, only_waiting: bool = False) -> None:
    """Ask a job to end, of an array its children too; nothing is committed. One that has ended stays as it is.

    Args:
        job_id: Of the job.
        reason: At most LONGEST_REASON characters.
        operation: For which the actor needs the permission.
        only_waiting: Leave a job that has begun to start as it is.

    Raises:
        UnknownJob: There is no such job.
        ClientError: The actor may not end it, or the reason is too long.
    """
    check_reason(reason, operation)
    job = context.session.get(Job, job_id)
    if job is None:
        raise UnknownJob(f"Job {job_id[:300]} does not exist")
    context.actor.check(operation, job)
    target = or_(Job.id == job.id, Job.parent == job.id) if job.kind == "array" else Job.id == job.id
    ask_to_end(context.session, target, reason, cancel=only_waiting)


def check_reason(reason: str, operation: Operation) -> None:
    """Raise ClientError for a reason that is too long to be kept."""
    if len(reason) > LONGEST_REASON:
        raise ClientError(f"{operation}: the reason is longer than {LONGEST_REASON} characters")


def stop(controller: Controller, actor: Actor, job_ids: Sequence[str], reason: str) -> dict[str, ClientError]:
    """Ask jobs to end, in one transaction; returns why some were not asked, by their ids. One that is not there counts as ended."""
    controller.writes.check(adds=False)
    refused: dict[str, ClientError] = {}
    with controller.writes.session() as session:
        context = Context(session, controller, actor)
        for job_id in job_ids:
            try:
                end(context, job_id, reason, Operation.TERMINATE_JOB)
            except UnknownJob:
                continue
            except ClientError as error:
                refused[job_id] = error
    controller.work_queue.alarm.set()
    return refused
