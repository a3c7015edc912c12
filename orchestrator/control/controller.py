"""The controller of one database and one store: its parts, put together, and the loop that drives every job to its end.

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
from orchestrator.control.disk import DEFAULT, Disk, MinFree
from orchestrator.control.isolation import Isolation, LoadedJobs
from orchestrator.control.kept_texts import KeptTexts
from orchestrator.control.log_hub import LogHub
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.peers import Peers
from orchestrator.control.retention import Retention
from orchestrator.control.run_store import RunStore
from orchestrator.control.snapshot import open_attempts
from orchestrator.control.store_access import StoreAccess
from orchestrator.control.store_identity import StoreIdentity
from orchestrator.control.upkeep import INTERVAL, Upkeep
from orchestrator.control.work_queue import WorkQueue
from orchestrator.control.writes import Writes
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.batch_models import Attempt, Job
from orchestrator.persistence.session import Database
from shared_store.volume.layout import Store

_SETTLED_A_TICK = 1000
"""Jobs that only change their state, in one pass: a large array that ends must not delay running gangs."""
_GATHERING = 0.02
"""Seconds between a wake-up and the pass: changes that come together cost one commit and one pass."""
_WITHOUT_DATABASE = 1.0
"""Seconds between two tries of a database that can't be used."""
_SOON = 1.0
"""Seconds until a gang is observed again after a failure."""

log = logging.getLogger("muster.controller")


class Controller:
    """The parts of a running controller, by name: what use cases act on and the server is made of."""

    def __init__(
        self,
        database: Database,
        engines: EngineSet,
        store: Store,
        bus: Bus,
        peers: Peers,
        *,
        interval: float = 0.2,
        retention: float | None = None,
        clock: Clock | None = None,
        min_free: MinFree = DEFAULT,
        identity: StoreIdentity | None = None,
        runs: RunStore | None = None,
        disk: Disk | None = None,
    ) -> None:
        """
        Args:
            database: Of the jobs; ``engines`` start their gangs, ``store`` has their runs, ``bus`` reaches their nodes.
            peers: The other controllers of the store.
            interval: Seconds between two passes where nothing calls for one.
            retention: Seconds for which ended jobs are kept, as :class:`.retention.Retention` says.
            min_free: Free space that the volumes of the store and the database need for something new to start.
            identity: Of the store; without it whatever is at its path is the store.
            clock, runs, disk: Steady time, the store as the loop uses it, and the volumes; made here where they are None.

        Raises:
            DatabaseError: The database can't be read.
        """
        machine.share_arenas()  # before the bus starts its threads
        self.database, self.engines, self.bus = database, engines, bus
        self.clock, self.monitoring, self.work_queue = clock or Clock(), Monitoring(), WorkQueue()
        volumes = {"store": store.path, "database": database.volume}
        checks = {"store": identity.problem} if identity else {}
        disk = disk or Disk({name: path for name, path in volumes.items() if path is not None}, min_free, checks)
        self._loaded = LoadedJobs(database)
        self._isolation = isolation = Isolation(database, self._loaded, self.monitoring)
        self.writes, self.access = Writes(database, isolation, disk), StoreAccess(store, peers, disk, identity)
        self.logs = LogHub(database, bus, self.access.followed)
        runs = runs or RunStore(store, peers, *([identity.check] if identity else []))
        self.texts = KeptTexts(database, store, runs.peers.id, self.writes.lock, self.access.shortage)
        self.retention = Retention(database, self.access, self.writes.lock, self.clock.now, retention)
        changed, withdrawn = self.work_queue.gang_changed, isolation.withdrawn
        self.attempts = Attempts(engines, runs, bus, self.clock, self.monitoring, changed, withdrawn, self.texts)
        self.admission = Admission(
            engines, disk, self.work_queue, self._loaded, self.clock, self.monitoring, isolation, self.attempts
        )
        self.upkeep = Upkeep(database, self.writes, self.access, self.texts, self.retention, self.monitoring)
        self._interval = interval
        self._is_cut_off = False
        self._kept, self._kept_version = 0.0, -1
        self._ending = threading.Event()
        self._ticking: int | None = None
        """The thread that makes a pass now."""
        self._thread: threading.Thread | None = None
        bus.changed = engines.changed = changed
        database.committed, database.changed = self._committed, self._recheck
        isolation.before, self._loaded.reread = self.attempts.load_shared_rows, self.attempts.forget_states
        with database.session() as session:
            self.clock.restore(session)
            self._take_up(session)  # before the router is there for the nodes

    def start(self) -> None:
        """Watch the volumes, and begin to drive jobs."""
        self.access.disk.start()
        self._thread = machine.thread("controller", self._loop)
        machine.collect_seldom()

    def close(self) -> None:
        """Stop driving jobs; running gangs continue, and the next controller on this database finds them."""
        self.retention.close()
        self.access.disk.close()
        self._ending.set()
        self.work_queue.alarm.set()
        if self._thread is not None:
            self._thread.join()
            machine.collect_all()
        self.attempts.close()
        self.logs.close()
        self.access.close()

    def problem(self) -> str | None:
        """Why the controller can't do its work now, as its loop has left it; waits for nothing."""
        return self.monitoring.loop_problem() or self.trouble or self.access.disk.absent("store")

    @property
    def trouble(self) -> str | None:
        """Why the database can't be used at present: nothing is launched, and no request is accepted."""
        return self._isolation.trouble

    def _loop(self) -> None:
        while not self._ending.is_set():
            self._isolation.part("reconciling", self.tick)
            if self.work_queue.alarm.wait(self._interval if self.trouble is None else _WITHOUT_DATABASE):
                self._ending.wait(_GATHERING)
            self.work_queue.alarm.clear()

    def tick(self) -> None:
        """One pass over every job that needs it; one that can't be handled now does not hold up the others.

        Raises DatabaseError where the database can't be used; the next pass tries again.
        """
        started, self._ticking = machine.monotonic(), threading.get_ident()
        self.monitoring.beat()
        try:
            self._pass()
        finally:
            self._ticking = None
            self.monitoring.loop.observe(machine.monotonic() - started)

    def _pass(self) -> None:
        self.database.reserve_connections()
        self._keep_database()
        if self.clock.stepped or self.work_queue.has_ended:
            with self.database.session() as session:
                if self.clock.stepped:
                    self.clock.note_step(session)
                self.work_queue.take_dependents(session)
        taken = self.work_queue.take_due(_SETTLED_A_TICK)
        due = [job_id for job_id in taken if not self._isolation.backoff.waits(("settle", job_id))]
        self.work_queue.recheck(job_id for job_id in taken if self._isolation.backoff.waits(("settle", job_id)))
        if due and len(taken) == _SETTLED_A_TICK:
            self.work_queue.alarm.set()  # the rest comes after the gangs that run
        self.work_queue.recheck(self._isolation.jobs("settle", due, self._settle))
        if self._kept_version != self.work_queue.version:
            self._kept_version = self.work_queue.version
            self._loaded.keep(self.work_queue.active())
        self.engines.poll()
        self._observe_gangs()
        why = self.bus.presence.cut_off
        if (why is not None) != self._is_cut_off:
            self._is_cut_off = why is not None
            log.warning("%s", f"{why}: no gang ends for it" if why else "nodes are heard again")
        self._isolation.part("scheduling", self.admission.schedule)
        self._isolation.part("clearing away", self._clear)

    def _observe_gangs(self) -> None:
        active = self.work_queue.take_active(machine.monotonic())
        try:
            due = [job_id for job_id in active if not self._isolation.backoff.waits(("advance", job_id))]
            self._isolation.jobs("advance", due, self._advance)
        finally:
            for job_id in active:
                self.work_queue.later(job_id, machine.monotonic() + _SOON)

    def _keep_database(self) -> None:
        """Check the database, and read the jobs anew where it is back. Raises DatabaseError where it is unavailable or another controller's."""
        self.database.check()
        if self.trouble is not None or machine.monotonic() - self._kept > INTERVAL:
            self.database.keep_lock()
            self._kept = machine.monotonic()
        if self.trouble is not None:
            with self.writes.lock, self.database.session() as session:  # nothing is submitted while jobs are counted
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
        return None if (attempt := job.open_attempt) is None else self._observe(session, job, attempt)

    def _observe(self, session: Session, job: Job, attempt: Attempt) -> Steps:
        yield from self.attempts.advance(session, job, attempt)
        self.work_queue.later(job.id, machine.monotonic() + self.attempts.pause(job, attempt))

    def _committed(self, jobs: Sequence[Job]) -> None:
        """Note the jobs of a commit as they are, where this thread has made it; read them again after a commit of a request."""
        if threading.get_ident() == self._ticking:
            self.work_queue.note(jobs)
            self.logs.changed(job.id for job in jobs)
        else:
            self._recheck([job.id for job in jobs])

    def _recheck(self, ids: Collection[str]) -> None:
        """Try failed actions on these jobs at once, since requests have changed the jobs."""
        self._loaded.changed(ids)
        self.logs.changed(ids)
        for job_id in ids:
            for what in ("settle", "advance", "cancel", "preempt", "start"):
                self._isolation.backoff.hurry((what, job_id))
        self.work_queue.recheck(ids)

    def _settle(self, session: Session, job: Job) -> None:
        self.work_queue.note([job])
        settle(session, job, self.clock)

    def _clear(self) -> None:
        self._isolation.backoff.tidy()
        self.upkeep.run()
