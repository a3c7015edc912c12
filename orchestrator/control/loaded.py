"""The jobs with a gang, as the controller's thread has them loaded: read once, and again after a request has changed them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.session import Database


class LoadedJobs:
    """One session that stays open between the passes of the loop, without a transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._changed: set[str] = set()
        """Ids of jobs that were changed elsewhere since they were loaded."""
        self._jobs: dict[str, Job] = {}
        self._session: Session | None = None
        self.reread: Callable[[Collection[str]], None] = lambda ids: None
        """Called with the jobs that are read from the database, also those that were known before."""

    def changed(self, ids: Collection[str]) -> None:
        """These jobs were changed elsewhere. Any thread may call."""
        with self._lock:
            self._changed.update(ids)

    @contextmanager
    def session(self) -> Iterator[Session]:
        """The session, committed at the end of the block; after an error everything is read anew.

        Raises DatabaseError.
        """
        if self._session is None:
            self._session = self._database.open()
        try:
            with self._database.using(self._session):
                yield self._session
        except BaseException:
            self.forget()
            raise

    def jobs(self, session: Session, ids: Sequence[str]) -> Mapping[str, Job]:
        """Those of these jobs that exist, with their attempts."""
        with self._lock:
            changed, self._changed = self._changed, set()
        for job_id in changed:
            if (job := self._jobs.pop(job_id, None)) is not None:
                session.expire(job)
        if missing := [job_id for job_id in ids if job_id not in self._jobs]:
            self.reread(missing)
            query = select(Job).where(Job.id.in_(missing)).options(selectinload(Job.attempts))
            self._jobs |= {job.id: job for job in session.scalars(query.execution_options(populate_existing=True))}
        return {job_id: self._jobs[job_id] for job_id in ids if job_id in self._jobs}

    def keep(self, ids: Collection[str]) -> None:
        """Forget all but these jobs."""
        for job_id in self._jobs.keys() - ids:
            job = self._jobs.pop(job_id)
            if self._session is not None and job in self._session:
                # it and its attempts refer to one another: so they go at once, without a search for garbage
                self._session.expire(job, ["attempts"])

    def forget(self) -> None:
        """Read everything anew."""
        self._jobs = {}
        if self._session is not None:
            self._session.close()
            self._session = None
