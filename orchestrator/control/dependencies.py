"""Jobs without a gang: their dependencies, ends on request, the end of an array by its children, and readiness to run."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from orchestrator.control.clock import Clock
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.job import WAITING, Status
from orchestrator.domain.reasons import array_of, named
from orchestrator.persistence.batch_models import Job
from shared_store.contract.error_text import enumerated

_NAMED = 3
"""Greatest number of failed children that an array's reason names."""
_LONGEST = 120
"""Greatest number of characters of a child's reason in it."""


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
            first = [session.get_one(Job, each) for each in pending[:_NAMED]]
            names = enumerated([named(each.name, each.id) for each in first], len(pending))
            job.move(Status.PENDING, f"waits for the success of job{'s' if len(pending) > 1 else ''} {names}")
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
        job.move(Status.PENDING, array_of(job.array_size))
    if left:
        return
    failed = counts.get(Status.FAILED, 0)
    if failed:
        job.move(Status.FAILED, job.stop_reason or _failed_children(session, job, failed))
    else:
        job.move(Status.SUCCEEDED, "all array jobs succeeded")


def _failed_children(session: Session, array: Job, failed: int) -> str:
    """How many children failed, and the first of them by index, each with the start of its reason."""
    children = select(Job).where(Job.parent == array.id, Job.status == Status.FAILED)
    first = session.scalars(children.order_by(Job.array_index).limit(_NAMED)).all()
    words = [f"{each.array_index} ({excerpt(' '.join(each.reason.words.split()), _LONGEST)})" for each in first]
    others = [f"{failed - len(words)} more"] if failed > len(words) else []
    return f"{failed} of {array.array_size} array jobs failed: {', '.join([*words, *others])}"


def _state(session: Session, job_id: str) -> str:
    job = session.get(Job, job_id)
    return job.status if job is not None else Status.FAILED
