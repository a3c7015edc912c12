"""The controller of one database and one store: its parts, put together."""

from __future__ import annotations

from orchestrator import machine
from orchestrator.control.admission import Admission
from orchestrator.control.attempts import Attempts
from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.disk import DEFAULT, Disk, MinFree
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


class Controller:
    """The parts of a running controller, by name: what use cases act on and the server is made of. It does nothing itself."""

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
        self.database, self.engines, self.bus = database, engines, bus
        self.clock, self.monitoring, self.work_queue = clock or Clock(), Monitoring(), WorkQueue()
        volumes = {"store": store.path, "database": database.volume}
        checks = {"store": identity.problem} if identity else {}
        disk = disk or Disk({name: path for name, path in volumes.items() if path is not None}, min_free, checks)
        loaded = LoadedJobs(database)
        isolation = Isolation(database, loaded, self.monitoring)
        self.writes, self.access = Writes(database, isolation, disk), StoreAccess(store, peers, disk, identity)
        self.logs = LogHub(database, bus, self.access.followed)
        runs = runs or RunStore(store, peers, *([identity.check] if identity else []))
        self.texts = KeptTexts(database, store, runs.peers.id, self.writes.lock, self.access.shortage)
        self.retention = Retention(database, self.access, self.writes.lock, self.clock.now, retention)
        changed, withdrawn = self.work_queue.gang_changed, isolation.withdrawn
        self.attempts = Attempts(engines, runs, bus, self.clock, self.monitoring, changed, withdrawn, self.texts)
        self.admission = Admission(
            engines, disk, self.work_queue, loaded, self.clock, self.monitoring, isolation, self.attempts
        )
        self.upkeep = Upkeep(database, self.writes, self.access, self.texts, self.retention, self.monitoring)
        self.reconciler = Reconciler(
            database,
            engines,
            bus,
            self.clock,
            self.writes,
            self.work_queue,
            loaded,
            isolation,
            self.monitoring,
            self.attempts,
            self.admission,
            self.logs,
            self.upkeep,
            interval,
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
        return self.monitoring.loop_problem() or self.reconciler.trouble or self.access.disk.absent("store")
