"""The controller's work queue, in memory: jobs that wait for resources, those with a gang, and those to be settled.

It follows every commit, and is read anew from the database at a start, so that 100,000 waiting jobs cost no query a pass.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from itertools import islice
from math import inf
from sys import intern

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.domain.gang import Shape
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.persistence.batch_models import Dependency, Job
from orchestrator.scheduling.snapshot import Waiting

_LOADED_AT_ONCE = 1000


class WorkQueue:
    """Jobs by the controller's next action on them. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, Waiting] = {}
        self._active: dict[str, float] = {}
        """When each is observed next (monotonic [s]); infinity while it is being observed."""
        self._due: dict[str, None] = {}
        self._ended: dict[str, None] = {}
        self._shapes: dict[Shape, Shape] = {}
        self.version = 0
        """Grows whenever something changes that a scheduling pass depends on."""
        self.alarm = threading.Event()
        """Set by whatever changes something: the controller's loop then makes a pass at once."""

    def gang_changed(self, gang: str) -> None:
        """A gang has changed, by its name or that of its job; empty: what an engine has."""
        if gang:
            self.hurry(gang.partition("/")[0])
        else:
            self.version += 1  # a pass depends on it
        self.alarm.set()

    def load(self, session: Session) -> None:
        """Read all jobs that are not over, and forget the earlier state. PENDING jobs become due: one on which they depend may have ended."""
        with self._lock:
            self._waiting, self._active = {}, {}
            self.version += 1
        query = select(Job).where(Job.status.not_in(TERMINAL)).order_by(Job.created_at, Job.id)
        in_parts = query.execution_options(yield_per=_LOADED_AT_ONCE)  # else all rows are in memory at once
        for jobs in session.scalars(in_parts).partitions():
            self.note(jobs)
            self.recheck(job.id for job in jobs if job.status == Status.PENDING)
            for job in jobs:
                session.expunge(job)

    def note(self, jobs: Iterable[Job]) -> None:
        """These jobs are in the database as they are here: for the one thread that changes their states."""
        with self._lock:
            for job in jobs:
                self._note(job)

    def _note(self, job: Job) -> None:
        job_id, status = job.id, Status(job.status)
        waited, due_at = self._waiting.pop(job_id, None), self._active.pop(job_id, None)
        # not out of _due: whoever asked again may know of a change that came after this one was read
        if status.is_terminal:
            self._ended[job_id] = None
            if job.parent is not None:
                self._due[job.parent] = None
        elif status in (Status.STARTING, Status.RUNNING):
            self._active[job_id] = due_at or 0.0
        elif status is Status.RUNNABLE and job.stop_reason is None:
            try:
                self._waiting[job_id] = self._entry(job)
            except Exception:  # a damaged row, which is reported when the job is settled
                self._due[job_id] = None
        elif status is Status.SUBMITTED or job.stop_reason is not None:
            self._due[job_id] = None
        # a PENDING job is settled when one that it waits for, or a child of it, has ended
        if (waited is None, due_at is None) != (job_id not in self._waiting, job_id not in self._active):
            self.version += 1

    def take_due(self, most: int | None = None) -> Sequence[str]:
        """The jobs to be settled, oldest note first, at most so many; each is returned once."""
        with self._lock:
            due = list(islice(self._due, most))
            for job in due:
                del self._due[job]
        return due

    def recheck(self, jobs: Iterable[str]) -> None:
        """Return these at the next :meth:`take_due`, and at the next :meth:`take_active` where they have a gang."""
        with self._lock:
            for job in jobs:
                self._due[job] = None
                if job in self._active:
                    self._active[job] = 0.0

    def hurry(self, job: str) -> None:
        """Something of its gang has changed: return it at the next :meth:`take_active`."""
        with self._lock:
            if job in self._active:
                self._active[job] = 0.0

    def take_active(self, moment: float) -> Sequence[str]:
        """The jobs whose gang is to be observed by now (monotonic [s]); each gets its next time by :meth:`later`."""
        with self._lock:
            due = [job for job, due_at in self._active.items() if due_at <= moment]
            self._active.update(dict.fromkeys(due, inf))
        return due

    def later(self, job: str, moment: float) -> None:
        """Observe a gang next at this moment (monotonic [s]), unless something has changed since it was taken."""
        with self._lock:
            if self._active.get(job) == inf:
                self._active[job] = moment

    @property
    def has_ended(self) -> bool:
        """Whether jobs have ended since the last :meth:`take_dependents`."""
        return bool(self._ended)

    def take_dependents(self, session: Session) -> None:
        """Make the jobs due that depend on jobs that ended since the last call."""
        with self._lock:
            ended, self._ended = list(self._ended), {}
        try:
            for start in range(0, len(ended), _LOADED_AT_ONCE):
                some = ended[start : start + _LOADED_AT_ONCE]
                self.recheck(session.scalars(select(Dependency.job_id).where(Dependency.on_id.in_(some))))
        except BaseException:
            with self._lock:
                self._ended.update(dict.fromkeys(ended))
            raise

    def active(self) -> Sequence[str]:
        """The jobs whose gang starts, runs or is being stopped."""
        with self._lock:
            return list(self._active)

    def waiting(self) -> Sequence[Waiting]:
        """The jobs that wait for room."""
        with self._lock:
            return list(self._waiting.values())

    def since(self, job: str) -> int | None:
        """Time from which a job waits for room [ms]; None where it does not wait."""
        entry = self._waiting.get(job)
        return entry.since if entry else None

    def _entry(self, job: Job) -> Waiting:
        shape = job.gang.shape
        if len(self._shapes) > len(self._waiting):
            self._shapes.clear()
        shape = self._shapes.setdefault(shape, shape)
        since = job.runnable_at or job.created_at
        created = job.created_at if job.queued_since is None else job.queued_since
        owner = job.owner and intern(job.owner)
        return Waiting(job.id, job.name, job.queue, shape, job.priority, job.share, created, since, job.timeout, owner)
