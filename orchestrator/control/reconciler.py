"""The reconcile loop: database × scheduler × engine.

A controller that starts on the database of a dead one continues from there: what it decides is recorded before it is done.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.admission import Admission
from orchestrator.control.attempts import Attempts, Steps
from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.dependencies import settle
from orchestrator.control.disk import DEFAULT, Disk, MinFree
from orchestrator.control.heartbeat import Heartbeat
from orchestrator.control.isolation import Isolation
from orchestrator.control.kept_texts import KeptTexts
from orchestrator.control.loaded import LoadedJobs
from orchestrator.control.log_hub import LogHub
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.peers import Peers
from orchestrator.control.retention import Retention
from orchestrator.control.run_store import RunStore
from orchestrator.control.run_users import RunUsers
from orchestrator.control.snapshot import open_attempts
from orchestrator.control.store_calls import StoreCalls, StoreSilent
from orchestrator.control.store_identity import StoreAbsent, StoreIdentity
from orchestrator.control.work_queue import WorkQueue
from orchestrator.domain.job import TERMINAL
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.group_commit import GroupCommit
from orchestrator.persistence.models import Attempt, Job, JobQueue
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import Database, DatabaseError, DatabaseFull
from shared_store.volume.initial_weights import WeightsCopy
from shared_store.volume.layout import Store

_SETTLED_A_TICK = 1000
"""Jobs that only change their state, in one pass: a large array that ends must not delay the looks at running gangs."""
_GATHERING = 0.02
"""Seconds between a wake-up and the look: changes that come together cost one commit and one pass."""
_WITHOUT_DATABASE = 1.0
"""Seconds between two tries of a database that can't be used."""
_SOON = 1.0
"""Seconds until the next look at a gang after one that failed."""
_SWEEP_INTERVAL = 2.0
"""Seconds between two looks for queues that are gone and other things that nothing needs."""

log = logging.getLogger("muster.controller")


class Reconciler:
    """Drives every job of a database to its end."""

    def __init__(
        self,
        database: Database,
        engine: EngineSet,
        store: Store,
        bus: Bus,
        peers: Peers,
        interval: float = 0.2,
        retention: float | None = None,
        clock: Clock | None = None,
        min_free: MinFree = DEFAULT,
        identity: StoreIdentity | None = None,
        runs: RunStore | None = None,
        disk: Disk | None = None,
    ) -> None:
        """``interval``: seconds between two looks at the engine; ``retention``: seconds for which ended jobs are kept, as
        :class:`.retention.Retention` says;
        ``identity``: of the store; without it whatever is at its path is the store.
        ``min_free``: free space that the volumes of the store and the database need for something new to start.
        """
        machine.share_arenas()  # before the bus starts its threads
        self.database, self.engine, self.store, self.bus, self.peers = database, engine, store, bus, peers
        self.interval = interval
        volumes = {"store": store.path, "database": database.volume}
        checks = {"store": identity.problem} if identity else {}
        self._identity = identity
        self.disk = disk or Disk({name: path for name, path in volumes.items() if path is not None}, min_free, checks)
        self.calls = StoreCalls(store.path, self.store_problem)
        """The store, for requests."""
        self.followed = StoreCalls(store.path, self.store_problem)
        """The store, for those who follow logs and live pages: each has one call at most, however long that takes."""
        self.logs = LogHub(database, bus, self.followed)
        self._is_cut_off = False
        self.work_queue = WorkQueue()
        self._loaded = LoadedJobs(database)
        self.clock = clock or Clock()
        self.writing = threading.Lock()
        """Held while something is registered, submitted or changed: checks must still hold at the commit."""
        runs = runs or RunStore(store, peers, *([identity.check] if identity else []))
        self.texts = KeptTexts(database, store, runs.peers.id, self.writing, lambda: self.disk.shortage("store"))
        self.monitoring, self.heartbeat = Monitoring(), Heartbeat()
        self.attempts = Attempts(
            engine,
            runs,
            bus,
            self.clock,
            self.monitoring,
            self._gang_changed,
            self._withdrawn,
            self.texts,
        )
        self.beginning: dict[str, WeightsCopy] = {}
        """Runs that get files before the database has their jobs, by name; nobody else may write them. Entered under :attr:`writing`."""
        self.submissions = GroupCommit(database, self.writing)
        self.run_users = RunUsers()
        self.retention = Retention(
            database,
            store,
            peers,
            self.run_users,
            self.beginning,
            self.writing,
            self.check_store,
            self.clock.now,
            retention,
        )
        bus.changed = engine.changed = self._gang_changed
        database.committed = self._committed
        database.changed = self._look_again
        self._swept = self._kept = 0.0
        self._kept_version = -1
        self._is_draining = True
        """Whether a deleted queue may still be there."""
        self._wake, self._ending = threading.Event(), threading.Event()
        self._ticking: int | None = None
        """The thread that makes a pass now."""
        self._isolation = Isolation(database, self._loaded, self.heartbeat)
        self._backoff = self._isolation.backoff
        self._isolation.before, self._loaded.reread = self.attempts.share, self.attempts.forget_states
        self.admission = Admission(
            engine,
            self.disk,
            self.work_queue,
            self._loaded,
            self.clock,
            self.monitoring,
            self._isolation,
            self.attempts,
        )
        self._thread: threading.Thread | None = None
        with database.session() as session:
            self.clock.restore(session)
            self._take_up(session)  # before the router is there for the nodes

    @property
    def trouble(self) -> str | None:
        """Why the database can't be used at present: nothing is launched, and no request is accepted."""
        return self._isolation.trouble

    def start(self) -> None:
        self.disk.start()
        self._thread = machine.thread("controller", self._loop)
        machine.collect_seldom()

    def wake(self) -> None:
        """Look now instead of at the next interval, since something changed."""
        self._wake.set()

    def _gang_changed(self, gang: str) -> None:
        """Look at a gang now, by its name or that of its job; empty: what an engine has, changed."""
        if gang:
            self.work_queue.hurry(gang.partition("/")[0])
        else:
            self.work_queue.version += 1  # a pass depends on it
        self.wake()

    def _withdrawn(self, job_id: str, reason: str) -> None:
        """A job can't start now: it is tried again at growing intervals."""
        self._backoff.failed(("start", job_id), reason, of=f"job {job_id}")

    def close(self) -> None:
        """Leave the loop; running gangs continue, and the next controller on this database finds them."""
        self._ending.set()
        self.retention.close()
        self.disk.close()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
            machine.collect_all()
        self.attempts.close()
        self.logs.close()
        self.calls.close()
        self.followed.close()

    def store_problem(self) -> str | None:
        """Why the store can't be read; None where it can, as far as was seen."""
        return self.disk.away("store")

    def check_store(self) -> None:
        """Raises StoreSilent where what is at the store's path now is not the store: what is missing there may be missing for that."""
        if self._identity is not None and (problem := self._identity.problem()) is not None:
            raise StoreSilent(problem)

    def problem(self) -> str | None:
        """Why the controller can't do its work now, as its loop has left it; waits for nothing."""
        return self.heartbeat.problem() or self.trouble or self.disk.absent("store")

    def _loop(self) -> None:
        while not self._ending.is_set():
            self._isolation.part("reconciling", self.tick)
            if self._wake.wait(self.interval if self.trouble is None else _WITHOUT_DATABASE):
                self._ending.wait(_GATHERING)
            self._wake.clear()

    def tick(self) -> None:
        """One pass over every job that needs a look; one that can't be handled now does not hold up the others.

        Raises DatabaseError where the database can't be used; the next pass tries again.
        """
        started, self._ticking = machine.monotonic(), threading.get_ident()
        self.heartbeat.beat()
        try:
            self._pass()
        finally:
            self._ticking = None
            self.monitoring.loop_took(machine.monotonic() - started)

    def _pass(self) -> None:
        self.database.reserve_connections()
        self._keep_database()
        if self.clock.stepped or self.work_queue.has_ended:
            with self.database.session() as session:
                if self.clock.stepped:
                    self.clock.note_step(session)
                self.work_queue.take_dependents(session)
        taken = self.work_queue.take_due(_SETTLED_A_TICK)
        due = [job_id for job_id in taken if not self._backoff.waits(("settle", job_id))]
        self.work_queue.look_again(job_id for job_id in taken if self._backoff.waits(("settle", job_id)))
        if due and len(taken) == _SETTLED_A_TICK:
            self.wake()  # the rest comes after a look at the gangs that run
        self.work_queue.look_again(self._isolation.jobs("settle", due, self._settle))
        if self._kept_version != self.work_queue.version:
            self._kept_version = self.work_queue.version
            self._loaded.keep(self.work_queue.active())
        self.engine.look()
        self._look_at_gangs()
        self._note_silence()
        self._isolation.part("scheduling", self.admission.look)
        self._isolation.part("clearing away", self._sweep)

    def _look_at_gangs(self) -> None:
        active = self.work_queue.take_active(machine.monotonic())
        try:
            due = [job_id for job_id in active if not self._backoff.waits(("advance", job_id))]
            self._isolation.jobs("advance", due, self._advance)
        finally:
            for job_id in active:
                self.work_queue.later(job_id, machine.monotonic() + _SOON)

    def _note_silence(self) -> None:
        why = self.bus.presence.cut_off
        if (why is not None) != self._is_cut_off:
            self._is_cut_off = why is not None
            log.warning("%s", f"{why}: no gang ends for it" if why else "nodes are heard again")

    def _keep_database(self) -> None:
        """Check the database, and read the jobs anew where it is back. Raises DatabaseError where it is unavailable or another controller's."""
        self.database.check()
        if self.trouble is not None or machine.monotonic() - self._kept > _SWEEP_INTERVAL:
            self.database.keep_lock()
            self._kept = machine.monotonic()
        if self.trouble is not None:
            with self.writing, self.database.session() as session:  # nothing is submitted while jobs are counted
                self.clock.rewrite(session)  # to be read is not enough: its volume may be full
                self._loaded.forget()  # another controller may have had the database meanwhile
                self._take_up(session)
            self._isolation.trouble = None
            log.warning("the database can be used again")

    def _take_up(self, session: Session) -> None:
        """Read the jobs, and expect the nodes of all open attempts, and of no other."""
        self.work_queue.load(session)
        self.database.counts.load(session)
        found = {(job.id, attempt.number): attempt for job, attempt in open_attempts(session, self.work_queue.active())}
        expected = self.bus.presence.expected()
        self.attempts.leave_closed(session, found.keys())
        for closed in expected - found.keys():
            self.bus.forget(*closed)
        for key in found.keys() - expected:
            nodes = found[key].nodes
            self.bus.expect(*key, len(nodes), [node.index for node in nodes if node.met])

    def _advance(self, session: Session, job: Job) -> Steps | None:
        return None if (attempt := job.open_attempt) is None else self._look_at(session, job, attempt)

    def _look_at(self, session: Session, job: Job, attempt: Attempt) -> Steps:
        yield from self.attempts.advance(session, job, attempt)
        self.work_queue.later(job.id, machine.monotonic() + self.attempts.pause(job, attempt))

    def _committed(self, jobs: Sequence[Job]) -> None:
        """Note the jobs of a commit as they are, where this thread has made it; read them again after a commit of a request."""
        if threading.get_ident() == self._ticking:
            self.work_queue.note(jobs)
            self.logs.changed(job.id for job in jobs)
        else:
            self._look_again([job.id for job in jobs])

    def _look_again(self, ids: Collection[str]) -> None:
        """Try failed actions on these jobs at once, since requests have changed the jobs."""
        self._loaded.changed(ids)
        self.logs.changed(ids)
        for job_id in ids:
            for what in ("settle", "advance", "cancel", "preempt", "start"):
                self._backoff.hurry((what, job_id))
        self.work_queue.look_again(ids)

    def _settle(self, session: Session, job: Job) -> None:
        self.work_queue.note([job])
        settle(session, job, self.clock)

    # -- what the API asks --------------------------------------------------------------------------------------------

    def check_writable(self, *, adds: bool) -> None:
        """Whether a request may change the database, to which it ``adds`` something or not.

        Raises:
            StoreAbsent: For an addition while the store is not there.
            DatabaseError: While the database can't be used, or is another controller's.
            DatabaseFull: For an addition while its volume has too little room.
        """
        if (trouble := self.trouble) is not None and (adds or not self._isolation.is_full):
            raise DatabaseError(trouble)
        if adds and (absent := self.disk.absent("store")):
            raise StoreAbsent(absent)
        if adds and (shortage := self.disk.shortage("database")):
            raise DatabaseFull(f"{shortage}, and nothing new is accepted")

    def drain(self, session: Session, queue: JobQueue) -> None:
        """Ask all jobs of a queue to end; it goes with the last of them."""
        self._is_draining = True
        ask_to_end(session, Job.queue == queue.name, f"job queue {queue.name} was deleted")

    def _sweep(self) -> None:
        """Remove deleted queues that are empty; have removed what nothing needs any more."""
        if machine.monotonic() - self._swept < _SWEEP_INTERVAL:
            return
        if not self.writing.acquire(blocking=False):
            return  # somebody writes: gangs must not wait for that
        try:
            self._swept = machine.monotonic()
            self._clear_away()
            self.texts.sweep_when_due(self.calls.later)
            self.retention.when_due(self.calls.later)
        finally:
            self.writing.release()

    def _clear_away(self) -> None:
        self._backoff.tidy()
        if self._is_draining:
            left, deleted = True, list[str]()
            try:
                with self.database.session() as session:
                    left, deleted = _delete_drained(session)
            finally:
                self._is_draining = left
            for queue in deleted:
                self.monitoring.forget_queue(queue)


def _delete_drained(session: Session) -> tuple[bool, list[str]]:
    """Delete the queues that are to go and have no open job; returns whether others are left, and the names of those deleted."""
    left, deleted = False, list[str]()
    for queue in session.scalars(select(JobQueue).where(JobQueue.deleting)):
        busy = select(Job.id).where(Job.queue == queue.name, Job.status.not_in(TERMINAL)).limit(1)
        if session.scalars(busy).first() is None:
            session.delete(queue)
            deleted.append(queue.name)
        else:
            left = True
    return left, deleted
