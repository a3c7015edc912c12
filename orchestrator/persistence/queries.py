"""Queries that find jobs in the database, and statements that change many at once."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from sqlalchemy import ColumnElement, and_, func, or_, select, update
from sqlalchemy.orm import Session, aliased

from orchestrator.domain.errors import RequestError
from orchestrator.domain.job import EARLY, TERMINAL, Status
from orchestrator.domain.reasons import named
from orchestrator.persistence.batch_models import Attempt, Job, Node

_NAMED = 5
"""Jobs that a refusal names."""


def note_changed(session: Session, ids: Iterable[str]) -> None:
    """Tell the controller after the commit that these jobs have changed: a statement changed them, not the session's objects."""
    session.info.setdefault("ids", {}).update(dict.fromkeys(ids))


def ask_to_end(session: Session, which: ColumnElement[bool], reason: str, *, cancel: bool = False) -> None:
    """Ask the jobs ``which`` that are not over to end, all at once; one that was asked already keeps its reason.

    An array is asked if one of its children is, and by the same request: a cancellation that finds all of them running leaves it
    alone, and a termination takes the place of an earlier cancellation.

    Args:
        session: Of the database.
        which: The jobs, an array with its children.
        reason: Why.
        cancel: Only those that have not begun to start, as CancelJob does; else as TerminateJob.
    """

    def free(job: type[Job]) -> ColumnElement[bool]:
        state = job.status.in_(EARLY) if cancel else job.status.not_in(TERMINAL)
        return and_(state, job.kind != "array", job.stop_reason.is_(None))

    child = aliased(Job)
    unasked = Job.stop_reason.is_(None) if cancel else or_(Job.stop_reason.is_(None), Job.cancelled)
    has_free_child = select(child.id).where(child.parent == Job.id, free(child)).exists()
    array = and_(which, Job.kind == "array", Job.status.not_in(TERMINAL), unasked, has_free_child)
    for requested in (
        array,
        and_(which, free(Job)),
    ):  # an array first, while its children show whether they can be asked
        note_changed(session, session.scalars(select(Job.id).where(requested)))
        changes = {"stop_reason": reason, "cancelled": cancel}
        session.execute(update(Job).where(requested).values(changes), execution_options={"synchronize_session": False})


def states_of(session: Session, ids: Collection[str]) -> dict[str, tuple[Status, int | None, int]]:
    """State of each of these jobs, and the number of its open attempt (None: it has none) with that of its nodes; those that are gone are left out."""
    query = (
        select(Job.id, Job.status, Attempt.number, func.count(Node.index))
        .outerjoin(Attempt, (Attempt.job_id == Job.id) & Attempt.stopped_at.is_(None))
        .outerjoin(Node, (Node.job_id == Attempt.job_id) & (Node.attempt == Attempt.number))
        .where(Job.id.in_(ids))
        .group_by(Job.id, Job.status, Attempt.number)
    )
    return {job: (Status(status), attempt, nodes) for job, status, attempt, nodes in session.execute(query)}


def unknown_job(
    session: Session, reference: str, queues: Collection[str] | None = None, owner: str | None = None
) -> str:
    """What to say where :func:`find_job`, with the same arguments, finds none."""
    array, _, index = reference.rpartition(":")
    parent = find_job(session, array, queues, owner) if index.isdecimal() and ":" not in array else None
    if parent is None:
        return f"job {reference} does not exist; `muster list` shows the jobs"
    job = f"job {named(parent.name, parent.id)}"
    if parent.kind != "array":
        return f"job {reference} does not exist: {job} is not an array"
    return f"job {reference} does not exist: the children of {job} are 0 to {(parent.array_size or 1) - 1}"


def find_job(
    session: Session, reference: str, queues: Collection[str] | None = None, owner: str | None = None
) -> Job | None:
    """The job with this id, else the newest one with this name, else the one whose id starts so.

    ``REFERENCE:3`` is the child with index 3 of the array that REFERENCE names.

    Args:
        session: Of the database.
        reference: Id, beginning of an id, or name.
        queues: Only jobs of these are found; None: all jobs.
        owner: Whose jobs of a name come before those of others.

    Raises:
        RequestError: Several ids start so.
    """
    job = session.get(Job, reference)
    if job:
        return job if queues is None or job.queue in queues else None
    array, colon, index = reference.rpartition(":")
    if colon:
        parent = find_job(session, array, queues, owner) if index.isdecimal() and ":" not in array else None
        return session.get(Job, f"{parent.id}:{index}") if parent else None
    among = select(Job)
    if queues is not None:  # an expression: the index of the queue's many jobs is not to be chosen
        among = among.where((Job.queue + "").in_(queues))
    newest = among.where(Job.name == reference, Job.parent.is_(None)).order_by(Job.created_at.desc()).limit(1)
    own = session.scalars(newest.where(Job.owner == owner)).first() if owner else None
    if named := own or session.scalars(newest).first():
        return named
    if len(reference) < 4:
        return None
    start = reference.lower()
    within = and_(Job.id >= start, Job.id < f"{start}g")  # by the index, which LIKE does not use: ids are hexadecimal
    starts = among.where(within, Job.id.startswith(start, autoescape=True), ~Job.id.contains(":"))
    prefixed = session.scalars(starts.order_by(Job.id).limit(_NAMED + 1)).all()
    if len(prefixed) > 1:
        shown = ", ".join(f"{each.id} ({each.name})" for each in prefixed[:_NAMED])
        more = ", …" * (len(prefixed) > _NAMED)
        raise RequestError(f"several jobs have an id that starts with {reference}: {shown}{more}; write more of it")
    return prefixed[0] if prefixed else None
