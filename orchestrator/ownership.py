"""Whose a run is: the queue of the job that created it, and who submitted that job.

The database remembers it, and so does ``run.json``: a run that is found in a store, by another controller or after the database
was lost, still has its owner.
"""

from __future__ import annotations

import os

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.tables import Job, RunRecord, now
from shared_store.layout import Run


def owner_of(session: Session, run: Run) -> RunRecord | None:
    """Whose the run is: as recorded, else as ``run.json`` says, else as its first job says; None where there is no such run.

    The record is in the session only where it was in the database. Its queue is empty for a run that says nothing about it.
    """
    record = session.get(RunRecord, run.name)
    if record is not None:
        return record
    try:
        description = run.description()
    except (OSError, ValueError, RecursionError):  # damaged: it says nothing, but the run exists
        description = {}
    queue, owner = (description or {}).get("queue"), (description or {}).get("owner")
    if isinstance(queue, str) and queue:
        return _record(run, queue, owner if isinstance(owner, str) else None)
    first = session.scalars(select(Job).where(Job.run == run.name).order_by(Job.created_at, Job.id).limit(1)).first()
    if first is not None:
        return _record(run, first.queue, first.owner)
    return None if description is None else _record(run, "", None)


def record_owner(session: Session, run: Run, job: Job) -> RunRecord:
    """The record of a run that ``job`` is about to create or continue, added to the session where there was none.

    A run that exists and says nothing about its queue belongs to that of ``job`` from now on: only a key with all queues gets
    that far.
    """
    record = session.get(RunRecord, run.name)
    if record is None:
        exists = os.path.lexists(run.path / "run.json")
        found = owner_of(session, run) if exists else None  # else an earlier job named the run and never started
        record = found if found and found.queue else _record(run, job.queue, job.owner)
        session.add(record)
    return record


def _record(run: Run, queue: str, owner: str | None) -> RunRecord:
    return RunRecord(name=run.name, queue=queue, owner=owner, created_at=now())
