"""The admission of jobs: which waiting ones a scheduling pass starts, which running ones make room, and why the others wait."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.attempts import Attempts, Steps
from orchestrator.control.clock import Clock
from orchestrator.control.disk import Disk
from orchestrator.control.isolation import Isolation, LoadedJobs
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.snapshot import holding_of, take_snapshot
from orchestrator.control.work_queue import WorkQueue
from orchestrator.domain.job import Status
from orchestrator.domain.reasons import Reason, named
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.batch_models import Job
from orchestrator.scheduling.decisions import Cancel, Decisions, Preempt, Start, decide
from orchestrator.scheduling.reasons import WaitReport
from orchestrator.scheduling.snapshot import Leading, RoundRobin

_PASS_INTERVAL, _LONGEST_PASS_INTERVAL = 1.0, 16.0
"""Seconds between passes while nothing changes, at first and at most: shares decay and limits run out by themselves."""
_PASS_SHARE = 0.2
"""Share of one CPU that passes may take."""

log = logging.getLogger("muster.controller")


class Admission:
    """Gives waiting jobs their room. Passes are made on the controller's thread alone; any thread may ask for reasons."""

    def __init__(
        self,
        engine: EngineSet,
        disk: Disk,
        work_queue: WorkQueue,
        loaded: LoadedJobs,
        clock: Clock,
        monitoring: Monitoring,
        isolation: Isolation,
        attempts: Attempts,
    ) -> None:
        self._engine, self._disk, self._work_queue, self._loaded = engine, disk, work_queue, loaded
        self._clock, self._monitoring, self._isolation, self._attempts = clock, monitoring, isolation, attempts
        self._backoff = isolation.backoff
        self._short = False
        self._report: WaitReport | None = None
        self._leading: Mapping[str, Leading] = {}
        self._turns = RoundRobin()
        self._passed: tuple[int, float, float] = (-1, 0.0, 0.0)
        """Of the last pass: the version of the work queue, when it began, and the seconds that it took."""
        self._pass_interval = _PASS_INTERVAL

    def schedule(self) -> None:
        """Make a scheduling pass, where something changed or time has passed, and enough space is free."""
        shortage = self._disk.shortage()
        if self._short != (shortage is not None):
            log.warning("%s", shortage or "the volumes answer again, and have enough free space")
            self._short = shortage is not None
        if shortage is not None:
            return
        version, at, took = self._passed
        pause = took / _PASS_SHARE
        idle = machine.monotonic() - at
        if idle < pause or (version == self._work_queue.version and idle < self._pass_interval):
            return
        calm = version == self._work_queue.version and not self._backoff  # what failed is due at moments of its own
        self._pass_interval = min(2 * self._pass_interval, _LONGEST_PASS_INTERVAL) if calm else _PASS_INTERVAL
        started, version = machine.monotonic(), self._work_queue.version
        waiting = self._work_queue.waiting()
        if self._backoff:  # seldom: there may be very many of them
            waiting = [each for each in waiting if not self._backoff.waits(("start", each.job))]
        if not waiting:
            self._report, self._passed = None, (version, started, 0.0)
            return
        unknown = self._engine.unknown()  # before the capacity: an engine may tell it in between
        with self._loaded.session() as session:
            holding = holding_of(self._loaded.jobs(session, self._work_queue.active()).values())
            snapshot = take_snapshot(
                session,
                self._clock,
                self._engine.capacity(),
                waiting,
                holding,
                self._leading,
                self._turns,
                self._engine.names[0],
                unknown,
            )
        decisions = decide(snapshot)
        self._report, self._leading, self._turns = decisions.report, decisions.leading, decisions.turns
        took = machine.monotonic() - started
        self._passed = (version, started, took)
        self._monitoring.passes.observe(took)
        self._carry_out(decisions)

    def _carry_out(self, decisions: Decisions) -> None:
        """Carry out each decision by itself: one that fails does not stop the others."""
        self._do("cancel", {each.job: partial(self._cancel, each) for each in decisions.cancels})
        self._do("preempt", {each.job: partial(self._preempt, each) for each in decisions.preempts})
        self._do("start", {each.job: partial(self._start, each) for each in decisions.starts})

    def _do(self, what: str, bodies: Mapping[str, Callable[[Session, Job], Steps | None]]) -> None:
        due = [job_id for job_id in bodies if not self._backoff.waits((what, job_id))]
        self._isolation.jobs(what, due, lambda session, job: bodies[job.id](session, job))

    @staticmethod
    def _cancel(cancel: Cancel, session: Session, job: Job) -> None:
        job.cancelled, job.stop_reason = True, cancel.reason

    def _preempt(self, preempt: Preempt, session: Session, job: Job) -> Steps | None:
        by = session.get_one(Job, preempt.by)
        if (attempt := job.open_attempt) is None:
            return None
        self._work_queue.hurry(job.id)
        return self._attempts.preempt(session, job, attempt, f"preempted by job {named(by.name, by.id)}")

    def _start(self, start: Start, session: Session, job: Job) -> Steps | None:
        # a request may have ended the job since the snapshot was taken
        if job.status == Status.RUNNABLE and job.stop_reason is None:
            return self._attempts.begin(session, job, start)
        self._work_queue.recheck([job.id])
        return None

    def reason(self, job: Job) -> Reason:
        """Why a job is in its state: why it waits now, a note for its user while it runs, how it ended."""
        return self._present_reason(job) or job.reason

    def _present_reason(self, job: Job) -> Reason | None:
        """What the last pass and the disk say of the job now; None where its own reason says all."""
        shortage, report = self._disk.shortage(), self._report
        if job.status in (Status.STARTING, Status.RUNNING):
            failure = self._backoff.failure(("preempt", job.id)) if report and report.preempts(job.id) else None
            reason = failure or job.status_reason or ""
            if shortage is not None and shortage not in reason:
                return Reason.plain("; ".join(filter(None, (reason, shortage))))
            return None if failure is None else Reason.plain(failure)
        if job.status != Status.RUNNABLE or self._work_queue.since(job.id) is None:
            return None
        if shortage is not None:
            return Reason.plain(shortage)
        if report is None:
            return None
        try:
            return report.reason(job.id)
        except KeyError:
            return None  # submitted since the last pass

    def front(self, queue: str, count: int) -> tuple[Sequence[str], Mapping[str, int]]:
        """The first waiting jobs of a queue in the order in which they will start, and since when each waits [ms].

        Of the first one: since when it is the first.
        """
        report, leading = self._report, self._leading.get(queue)
        order = [
            job for job in (report.order(queue)[:count] if report else []) if self._work_queue.since(job) is not None
        ]
        times = {job: since for job in order if (since := self._work_queue.since(job)) is not None}
        if leading is not None and leading.job in times:
            times[leading.job] = leading.since + self._clock.drift
        return order, times
