"""The controller of one database and one store: its parts, put together."""

from __future__ import annotations

from dataclasses import dataclass

from orchestrator import machine
from orchestrator.control.admission import Admission
from orchestrator.control.alarm import Alarm
from orchestrator.control.attempts import Attempts
from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.disk import DEFAULT, Disk, MinFree
from orchestrator.control.heartbeat import Heartbeat
from orchestrator.control.isolation import Isolation
from orchestrator.control.kept_texts import KeptTexts
from orchestrator.control.loaded import LoadedJobs
from orchestrator.control.log_hub import LogHub
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.peers import Peers
from orchestrator.control.reconciler import Reconciler
from orchestrator.control.retention import Retention
from orchestrator.control.run_store import RunStore
from orchestrator.control.store_access import StoreAccess
from orchestrator.control.store_identity import StoreIdentity
from orchestrator.control.upkeep import Upkeep
from orchestrator.control.work_queue import WorkQueue
from orchestrator.control.writes import Writes
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.session import Database
from shared_store.volume.layout import Store


@dataclass(frozen=True)
class Controller:
    """The parts of a running controller, by name: what use cases act on and the server is made of. It does nothing itself."""

    database: Database
    writes: Writes
    engines: EngineSet
    access: StoreAccess
    texts: KeptTexts
    bus: Bus
    clock: Clock
    logs: LogHub
    retention: Retention
    attempts: Attempts
    admission: Admission
    work_queue: WorkQueue
    monitoring: Monitoring
    heartbeat: Heartbeat
    alarm: Alarm
    upkeep: Upkeep
    reconciler: Reconciler

    @classmethod
    def assemble(
        cls,
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
    ) -> Controller:
        """
        Args:
            database: Of the jobs.
            engines: What starts their gangs.
            store: Of their runs.
            bus: To the nodes.
            peers: The other controllers of the store.
            interval: Seconds between two passes where nothing calls for one.
            retention: Seconds for which ended jobs are kept, as :class:`.retention.Retention` says.
            clock: Steady time.
            min_free: Free space that the volumes of the store and the database need for something new to start.
            identity: Of the store; without it whatever is at its path is the store.
            runs: The store as the loop uses it.
            disk: The volumes.

        Raises:
            DatabaseError: The database can't be read.
        """
        machine.share_arenas()  # before the bus starts its threads
        volumes = {"store": store.path, "database": database.volume}
        checks = {"store": identity.problem} if identity else {}
        disk = disk or Disk({name: path for name, path in volumes.items() if path is not None}, min_free, checks)
        clock, monitoring, heartbeat = clock or Clock(), Monitoring(), Heartbeat()
        work_queue, loaded = WorkQueue(), LoadedJobs(database)
        isolation = Isolation(database, loaded, heartbeat)
        writes, access = Writes(database, isolation, disk), StoreAccess(store, peers, disk, identity)
        logs = LogHub(database, bus, access.followed)
        runs = runs or RunStore(store, peers, *([identity.check] if identity else []))
        texts = KeptTexts(database, store, runs.peers.id, writes.lock, access.shortage)
        kept = Retention(
            database,
            store,
            peers,
            access.users,
            access.beginning,
            writes.lock,
            access.check,
            clock.now,
            retention,
        )
        alarm = Alarm(work_queue)
        attempts = Attempts(engines, runs, bus, clock, monitoring, alarm.gang_changed, isolation.withdrawn, texts)
        admission = Admission(engines, disk, work_queue, loaded, clock, monitoring, isolation, attempts)
        upkeep = Upkeep(database, writes, access, texts, kept, monitoring)
        reconciler = Reconciler(
            database,
            engines,
            bus,
            clock,
            writes,
            work_queue,
            loaded,
            isolation,
            heartbeat,
            alarm,
            monitoring,
            attempts,
            admission,
            logs,
            upkeep,
            interval,
        )
        return cls(
            database=database,
            writes=writes,
            engines=engines,
            access=access,
            texts=texts,
            bus=bus,
            clock=clock,
            logs=logs,
            retention=kept,
            attempts=attempts,
            admission=admission,
            work_queue=work_queue,
            monitoring=monitoring,
            heartbeat=heartbeat,
            alarm=alarm,
            upkeep=upkeep,
            reconciler=reconciler,
        )

    def start(self) -> None:
        """Watch the volumes, and begin to drive jobs."""
        self.access.disk.start()
        self.reconciler.start()

    def close(self) -> None:
        """Stop driving jobs; running gangs continue, and the next controller on this database finds them."""
        self.retention.close()
        self.access.disk.close()
        self.reconciler.close()
        self.attempts.close()
        self.logs.close()
        self.access.close()

    def problem(self) -> str | None:
        """Why the controller can't do its work now, as its loop has left it; waits for nothing."""
        return self.heartbeat.problem() or self.reconciler.trouble or self.access.disk.absent("store")
