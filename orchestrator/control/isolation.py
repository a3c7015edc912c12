"""The isolation of failures: a part of a pass that fails stops no other part, and a job that fails no other job.

The jobs with a gang are as the controller's thread has them loaded: read once, and again after a request has changed them.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager

from sqlalchemy import select, update
from sqlalchemy.orm import Session, selectinload

from orchestrator.control.attempts import Steps
from orchestrator.control.monitoring import Monitoring
from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from orchestrator.domain.job import TERMINAL
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.columns import storable
from orchestrator.persistence.session import Database, DatabaseError, DatabaseFull

_AT_ONCE = 1000
"""Jobs that share their commits, at most: one that fails has all of them done again, half of them at a time."""

log = logging.getLogger("muster.controller")


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


class Isolation:
    """Carries out the work of the controller's loop, and remembers what fails. On the controller's thread alone."""

    def __init__(self, database: Database, loaded: LoadedJobs, monitoring: Monitoring) -> None:
        self._database, self._loaded, self._monitoring = database, loaded, monitoring
        self.trouble: str | None = None
        """Why the database can't be used at present: nothing is launched, and no request is accepted."""
        self.is_full = False
        """Whether its volume is full; jobs are ended all the same."""
        self.backoff = Backoff(log)
        """Failures, by the part of the pass, or by the action on a job and the job's id."""
        self.before: Callable[[Session, Sequence[Job]], None] = lambda session, jobs: None
        """Called with the jobs that are worked on next."""

    def withdrawn(self, job_id: str, reason: str) -> None:
        """A job can't start now: it is tried again at growing intervals."""
        self.backoff.failed(("start", job_id), reason, of=f"job {job_id}")

    def part(self, what: str, body: Callable[[], None]) -> None:
        """Carry out one part of a pass."""
        try:
            body()
            self.backoff.worked(what)
        except DatabaseError as error:
            if self.trouble is None:
                log.error("%s; until it can be used again no job is started or accepted", error)
            self.trouble, self.is_full = str(error), isinstance(error, DatabaseFull)
        except Exception as error:
            self.backoff.failed(what, f"{what} failed ({_words(error)}); trying again", error)

    def jobs(self, what: str, ids: Sequence[str], body: Callable[[Session, Job], Steps | None]) -> Sequence[str]:
        """Do something to these jobs, with commits that some share; where that fails, to fewer at a time. Returns those for which it failed.

        They are logged once, have it as their reason, and should be tried again when ``(what, job)`` need not wait any longer.
        Raises DatabaseError.
        """
        portions = (ids[start : start + _AT_ONCE] for start in range(0, len(ids), _AT_ONCE))
        return [failed for portion in portions for failed in self._together(what, portion, body)]

    def _together(self, what: str, ids: Sequence[str], body: Callable[[Session, Job], Steps | None]) -> Sequence[str]:
        self._monitoring.beat()
        try:
            with self._loaded.session() as session:
                jobs = self._loaded.jobs(session, ids)
                self.before(session, list(jobs.values()))
                started = [body(session, job) for job in jobs.values()]
                self._finish(session, [steps for steps in started if steps is not None])
        except DatabaseError:
            raise
        except Exception as error:
            if len(ids) > 1:
                halves = ids[: len(ids) // 2], ids[len(ids) // 2 :]
                return [failed for half in halves for failed in self._together(what, half, body)]
            self._failed(what, ids[0], error)
            return ids
        for job_id in ids:
            self.backoff.worked((what, job_id), lasting=True)
        return []

    def _finish(self, session: Session, steps: Sequence[Steps]) -> None:
        """Carry all of them out, up to the next commit of each in turn."""
        while steps:
            with session.no_autoflush:  # none reads what another one has changed
                reached = [(each, then) for each in steps if (then := next(each, None)) is not None]
            session.commit()
            for _, then in reached:
                then()
            steps = [each for each, _ in reached]
            self._monitoring.beat()

    def _failed(self, what: str, job_id: str, error: Exception) -> None:
        """Note a failure of a job: logged once, shown as its reason, and tried again at growing intervals."""
        reason = f"the controller failed on this job ({_words(error)}); trying again"
        reason = excerpt(storable(reason), LONGEST_REASON)
        if self.backoff.failed((what, job_id), reason, error, of=f"job {job_id}"):
            with self._database.session() as session:  # by its id alone: its row may be what is damaged
                explained = (
                    update(Job).where(Job.id == job_id, Job.status.not_in(TERMINAL)).values(status_reason=reason)
                )
                session.execute(explained)
            self._loaded.changed([job_id])


def _words(error: Exception) -> str:
    """An unexpected error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
