"""The owner of a run: the queue of the job that created it, and the submitter of that job.

The database remembers it, and so does ``run.json``: a run that is found in a store, by another controller or after the database
was lost, still has its owner.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from sqlalchemy import ColumnElement, or_, select
from sqlalchemy.orm import Session

from orchestrator.domain.job import TERMINAL
from orchestrator.persistence.batch_models import Job, RunRecord, now
from shared_store import __version__


class FoundRun(Protocol):
    """A run as it is in the store, or as it was found there."""

    @property
    def name(self) -> str: ...
    def is_missing(self) -> bool:
        """Whether the store lacks it."""
        ...

    def description(self) -> Mapping[str, Any] | None:
        """Its ``run.json``. Raises ValueError where that is damaged."""
        ...


def owner_of(session: Session, run: FoundRun) -> RunRecord | None:
    """The owner and the queue of a run: as recorded, else as ``run.json`` says, else as its first job says.

    A run that does not exist belongs to the unfinished job that will create it, whatever is recorded of an earlier run of that
    name; None without such a job. The record is in the session only where it was in the database. Its queue is empty for a run
    that says nothing about it.
    """
    of_run = select(Job).where(Job.run == run.name).order_by(Job.created_at, Job.id).limit(1)
    if run.is_missing():
        writer = session.scalars(of_run.where(Job.status.not_in(TERMINAL))).first()
        return _record(run, writer.queue, writer.owner) if writer is not None else None
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
    first = session.scalars(of_run).first()
    if first is not None:
        return _record(run, first.queue, first.owner)
    return None if description is None else _record(run, "", None)


def first_description(run: FoundRun, job: Job, owner: str | None, queue: str) -> dict[str, Any]:
    """The first ``run.json`` of a run that ``job`` begins."""
    spec = job.gang.spec
    facts = {"run": run.name, "job": job.id, "created": now(), "version": __version__, "spec": spec, "name": job.name}
    return {**facts, "owner": owner, "queue": queue}


def born_at(run: FoundRun) -> int:
    """When the run was created [Unix ms]; 0 where it does not say."""
    try:
        created = (run.description() or {}).get("created")
    except (OSError, ValueError, RecursionError):  # damaged
        created = None
    return int(created) if isinstance(created, int | float) else 0


def is_of_earlier_run(job: Job, run: FoundRun) -> bool:
    """Whether a job's own run is gone, and ``run`` is another one that was created under its name afterwards."""
    return job.stopped_at is not None and job.stopped_at < born_at(run)


def jobs_of(run: FoundRun) -> list[ColumnElement[bool]]:
    """Conditions of the jobs that made and continued the run; not those of an earlier run of its name."""
    return [Job.run == run.name, or_(Job.stopped_at.is_(None), Job.stopped_at >= born_at(run))]


def forget_gone_run(session: Session, run: FoundRun) -> None:
    """Forget the owner of an earlier run of this name that is gone from the store: it has no rights to a new one. Commits."""
    if (record := session.get(RunRecord, run.name)) is not None:
        session.delete(record)
        session.commit()


def record_owner(session: Session, run: FoundRun, job: Job, record: RunRecord | None) -> RunRecord:
    """The record of a run that ``job`` is about to create or continue, added to the session where there was none.

    ``record``: the present one.

    A run that exists and says nothing about its queue belongs to that of ``job`` from now on: only a key with all queues gets
    that far. The record of an earlier run of that name, which is gone from the store, is replaced and committed: ``run.json``
    is written next, and a controller that is killed in between must not leave the new run to the old owner.
    """
    is_missing = run.is_missing()
    if record is None:
        found = None if is_missing else owner_of(session, run)
        record = found if found and found.queue else _record(run, job.queue, job.owner)
        session.add(record)
    elif is_missing and (record.queue, record.owner) != (job.queue, job.owner):
        record.queue, record.owner, record.created_at = job.queue, job.owner, now()
        session.commit()
    return record


def _record(run: FoundRun, queue: str, owner: str | None) -> RunRecord:
    return RunRecord(name=run.name, queue=queue, owner=owner, created_at=now())
