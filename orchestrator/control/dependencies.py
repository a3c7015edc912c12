"""Jobs that have no gang: ended on request, held back by others, an array by its children, or ready to run."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from orchestrator.control.clock import Clock
from orchestrator.domain.job import WAITING, Status
from orchestrator.persistence.models import Job


def settle(session: Session, job: Job, clock: Clock) -> None:
    """Move a job on as far as it goes without a gang. Raises ValueError where its row is damaged."""
    if job.is_terminal or job.open_attempt is not None:
        return
    if job.queued_since is None:
        job.queued_since = job.created_at - clock.drift
    if job.kind == "array":
        _settle_array(session, job)
    elif job.stop_reason is not None:
        job.move(Status.FAILED, job.stop_reason)
    elif job.status in (Status.SUBMITTED, Status.PENDING):
        states = {each.on_id: _state(session, each.on_id) for each in job.dependencies}
        failed = [on for on, status in states.items() if status == Status.FAILED]
        pending = [on for on, status in states.items() if status != Status.SUCCEEDED]
        if failed:
            job.move(Status.FAILED, f"Dependent Job failed: {failed[0]}")
        elif pending:
            others = f" and {len(pending) - 1} more" if len(pending) > 1 else ""
            job.move(Status.PENDING, f"waits for the success of job {pending[0]}{others}")
        else:
            job.move(Status.RUNNABLE, WAITING)
    elif job.status == Status.RUNNABLE:
        _ = job.gang  # raises where the row is damaged, which is why the job is looked at


def _settle_array(session: Session, job: Job) -> None:
    """An array is over when its last child is; one failed child makes it FAILED."""
    query = select(Job.status, func.count()).where(Job.parent == job.id).group_by(Job.status)
    counts: dict[str, int] = {status: count for status, count in session.execute(query)}
    left = sum(count for status, count in counts.items() if not Status(status).is_terminal)
    if job.status == Status.SUBMITTED:
        job.move(Status.PENDING, f"an array of {job.array_size}")
    if left:
        return
    failed = counts.get(Status.FAILED, 0)
    if failed:
        job.move(Status.FAILED, job.stop_reason or f"{failed} of {job.array_size} array jobs failed")
    else:
        job.move(Status.SUCCEEDED, "all array jobs succeeded")


def _state(session: Session, job_id: str) -> str:
    job = session.get(Job, job_id)
    return job.status if job is not None else Status.FAILED
