"""The reconcile loop: database × scheduler × engine.

A controller that starts on the database of a dead one continues from there: what it decides is recorded before it is done.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Sequence

from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.admission import Admission
from orchestrator.control.attempts import Attempts, Steps
from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.dependencies import settle
from orchestrator.control.isolation import Isolation
from orchestrator.control.loaded import LoadedJobs
from orchestrator.control.log_hub import LogHub
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.snapshot import open_attempts
from orchestrator.control.upkeep import INTERVAL, Upkeep
from orchestrator.control.work_queue import WorkQueue
from orchestrator.control.writes import Writes
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.batch_models import Attempt, Job
from orchestrator.persistence.session import Database

_SETTLED_A_TICK = 1000
"""Jobs that only change their state, in one pass: a large array that ends must not delay the looks at running gangs."""
_GATHERING = 0.02
"""Seconds between a wake-up and the look: changes that come together cost one commit and one pass."""
_WITHOUT_DATABASE = 1.0
"""Seconds between two tries of a database that can't be used."""
_SOON = 1.0
"""Seconds until the next look at a gang after one that failed."""

log = logging.getLogger("muster.controller")


class Reconciler:
    """Drives every job of a database to its end."""

    def __init__(
        self,
        database: Database,
        engines: EngineSet,
        bus: Bus,
        clock: Clock,
        writes: Writes,
        work_queue: WorkQueue,
        loaded: LoadedJobs,
        isolation: Isolation,
        monitoring: Monitoring,
        attempts: Attempts,
        admission: Admission,
        logs: LogHub,
        upkeep: Upkeep,
        interval: float,
    ) -> None:
        """``interval``: seconds between two passes where nothing rings the alarm of the work queue. Raises DatabaseError."""
        self._database, self._engines, self._bus, self._clock, self._writes = database, engines, bus, clock, writes
        self._work_queue, self._loaded, self._isolation = work_queue, loaded, isolation
        self._monitoring, self._attempts, self._admission, self._logs = monitoring, attempts, admission, logs
        self._upkeep = upkeep
        self.interval = interval
        self._backoff = isolation.backoff
        self._is_cut_off = False
        self._kept = 0.0
        self._kept_version = -1
        self._ending = threading.Event()
        self._ticking: int | None = None
        """The thread that makes a pass now."""
        self._thread: threading.Thread | None = None
        bus.changed = engines.changed = work_queue.gang_changed
        database.committed, database.changed = self._committed, self._look_again
        isolation.before, loaded.reread = attempts.load_shared_rows, attempts.forget_states
        with database.session() as session:
            clock.restore(session)
            self._take_up(session)  # before the router is there for the nodes

    @property
    def trouble(self) -> str | None:
        """Why the database can't be used at present: nothing is launched, and no request is accepted."""
        return self._isolation.trouble

    def start(self) -> None:
        self._thread = machine.thread("controller", self._loop)
        machine.collect_seldom()

    def close(self) -> None:
        """Leave the loop; running gangs continue, and the next controller on this database finds them."""
        self._ending.set()
        self._work_queue.ring()
        if self._thread is not None:
            self._thread.join()
            machine.collect_all()

    def _loop(self) -> None:
        while not self._ending.is_set():
            self._isolation.part("reconciling", self.tick)
            if self._work_queue.wait(self.interval if self.trouble is None else _WITHOUT_DATABASE):
                self._ending.wait(_GATHERING)
            self._work_queue.clear()

    def tick(self) -> None:
        """One pass over every job that needs a look; one that can't be handled now does not hold up the others.

        Raises DatabaseError where the database can't be used; the next pass tries again.
        """
        started, self._ticking = machine.monotonic(), threading.get_ident()
        self._monitoring.beat()
        try:
            self._pass()
        finally:
            self._ticking = None
            self._monitoring.loop_took(machine.monotonic() - started)

    def _pass(self) -> None:
        self._database.reserve_connections()
        self._keep_database()
        if self._clock.stepped or self._work_queue.has_ended:
            with self._database.session() as session:
                if self._clock.stepped:
                    self._clock.note_step(session)
                self._work_queue.take_dependents(session)
        taken = self._work_queue.take_due(_SETTLED_A_TICK)
        due = [job_id for job_id in taken if not self._backoff.waits(("settle", job_id))]
        self._work_queue.look_again(job_id for job_id in taken if self._backoff.waits(("settle", job_id)))
        if due and len(taken) == _SETTLED_A_TICK:
            self._work_queue.ring()  # the rest comes after a look at the gangs that run
        self._work_queue.look_again(self._isolation.jobs("settle", due, self._settle))
        if self._kept_version != self._work_queue.version:
            self._kept_version = self._work_queue.version
            self._loaded.keep(self._work_queue.active())
        self._engines.look()
        self._look_at_gangs()
        self._note_silence()
        self._isolation.part("scheduling", self._admission.look)
        self._isolation.part("clearing away", self._clear_away)

    def _look_at_gangs(self) -> None:
        active = self._work_queue.take_active(machine.monotonic())
        try:
            due = [job_id for job_id in active if not self._backoff.waits(("advance", job_id))]
            self._isolation.jobs("advance", due, self._advance)
        finally:
            for job_id in active:
                self._work_queue.later(job_id, machine.monotonic() + _SOON)

    def _note_silence(self) -> None:
        why = self._bus.presence.cut_off
        if (why is not None) != self._is_cut_off:
            self._is_cut_off = why is not None
            log.warning("%s", f"{why}: no gang ends for it" if why else "nodes are heard again")

    def _keep_database(self) -> None:
        """Check the database, and read the jobs anew where it is back. Raises DatabaseError where it is unavailable or another controller's."""
        self._database.check()
        if self.trouble is not None or machine.monotonic() - self._kept > INTERVAL:
            self._database.keep_lock()
            self._kept = machine.monotonic()
        if self.trouble is not None:
            with self._writes.lock, self._database.session() as session:  # nothing is submitted while jobs are counted
                self._clock.rewrite(session)  # to be read is not enough: its volume may be full
                self._loaded.forget()  # another controller may have had the database meanwhile
                self._take_up(session)
            self._isolation.trouble = None
            log.warning("the database can be used again")

    def _take_up(self, session: Session) -> None:
        """Read the jobs, and expect the nodes of all open attempts, and of no other."""
        self._work_queue.load(session)
        self._database.counts.load(session)
        found = {
            (job.id, attempt.number): attempt for job, attempt in open_attempts(session, self._work_queue.active())
        }
        expected = self._bus.presence.expected()
        self._attempts.leave_closed(session, found.keys())
        for closed in expected - found.keys():
            self._bus.forget(*closed)
        for key in found.keys() - expected:
            nodes = found[key].nodes
            self._bus.expect(*key, len(nodes), [node.index for node in nodes if node.met])

    def _advance(self, session: Session, job: Job) -> Steps | None:
        return None if (attempt := job.open_attempt) is None else self._look_at(session, job, attempt)

    def _look_at(self, session: Session, job: Job, attempt: Attempt) -> Steps:
        yield from self._attempts.advance(session, job, attempt)
        self._work_queue.later(job.id, machine.monotonic() + self._attempts.pause(job, attempt))

    def _committed(self, jobs: Sequence[Job]) -> None:
        """Note the jobs of a commit as they are, where this thread has made it; read them again after a commit of a request."""
        if threading.get_ident() == self._ticking:
            self._work_queue.note(jobs)
            self._logs.changed(job.id for job in jobs)
        else:
            self._look_again([job.id for job in jobs])

    def _look_again(self, ids: Collection[str]) -> None:
        """Try failed actions on these jobs at once, since requests have changed the jobs."""
        self._loaded.changed(ids)
        self._logs.changed(ids)
        for job_id in ids:
            for what in ("settle", "advance", "cancel", "preempt", "start"):
                self._backoff.hurry((what, job_id))
        self._work_queue.look_again(ids)

    def _settle(self, session: Session, job: Job) -> None:
        self._work_queue.note([job])
        settle(session, job, self._clock)

    def _clear_away(self) -> None:
        self._backoff.tidy()
        self._upkeep.look()
