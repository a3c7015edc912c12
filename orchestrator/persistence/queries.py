"""Finding jobs in the database, and changing many at once."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from sqlalchemy import ColumnElement, and_, select, update
from sqlalchemy.orm import Session

from orchestrator.domain.errors import RequestError
from orchestrator.domain.job import TERMINAL
from orchestrator.persistence.models import Job

_NAMED = 5
"""Jobs that a refusal names."""


def note_changed(session: Session, ids: Iterable[str]) -> None:
    """Tell the controller after the commit that these jobs have changed: a statement changed them, not the session's objects."""
    session.info.setdefault("ids", {}).update(dict.fromkeys(ids))


def ask_to_end(session: Session, which: ColumnElement[bool], reason: str, *, cancelled: bool = False) -> None:
    """Ask the jobs ``which`` that are not over to end, in one statement; one that was asked already keeps its reason."""
    asked = and_(which, Job.status.not_in(TERMINAL), Job.stop_reason.is_(None))
    note_changed(session, session.scalars(select(Job.id).where(asked)))
    changes = {"stop_reason": reason, **({"cancelled": True} if cancelled else {})}
    session.execute(update(Job).where(asked).values(changes), execution_options={"synchronize_session": False})


def short_id(job: str) -> str:
    """The start of a job's id, as commands show it; of an array's child with its index."""
    parent, colon, index = job.partition(":")
    return parent[:8] + colon + index


def find_job(session: Session, reference: str, queues: Collection[str] | None = None) -> Job | None:
    """The job with this id, else the newest one with this name, else the one whose id starts so.

    ``REFERENCE:3`` is the child with index 3 of the array that REFERENCE names.

    ``queues``: only jobs of these are found; None: all jobs.
    Raises RequestError where several ids start so.
    """
    job = session.get(Job, reference)
    if job:
        return job if queues is None or job.queue in queues else None
    array, colon, index = reference.rpartition(":")
    if colon:
        parent = find_job(session, array, queues) if index.isdecimal() and ":" not in array else None
        return session.get(Job, f"{parent.id}:{index}") if parent else None
    among = select(Job).where(Job.parent.is_(None))
    if queues is not None:
        among = among.where(Job.queue.in_(queues))
    named = session.scalars(among.where(Job.name == reference).order_by(Job.created_at.desc())).first()
    if named:
        return named
    if len(reference) < 4:
        return None
    prefixed = session.scalars(among.where(Job.id.startswith(reference, autoescape=True)).limit(_NAMED + 1)).all()
    if len(prefixed) > 1:
        shown = ", ".join(f"{each.id} ({each.name})" for each in prefixed[:_NAMED])
        more = ", …" * (len(prefixed) > _NAMED)
        raise RequestError(f"several jobs have an id that starts with {reference}: {shown}{more}; write more of it")
    return prefixed[0] if prefixed else None
