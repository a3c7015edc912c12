"""A controller on a fake engine, of which the test decides everything."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Generic, TypeVar

from orchestrator.control.bus import Bus
from orchestrator.control.compute_environments import ensure_compute_environments
from orchestrator.control.controller import Controller
from orchestrator.control.peers import Peers
from orchestrator.control.run_store import RunStore
from orchestrator.domain.job import Status
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import Job, JobQueue
from orchestrator.persistence.session import Database
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import Outcome, write_outcome
from tests.support.orchestrator.rows import job
from tests.support.waiting import wait_for

E = TypeVar("E", bound=FakeEngine)


def properties(cpus: int, nodes: int = 1, **variables: str) -> dict[str, Any]:
    """Of a native job; ``cpus`` of each node."""
    needs = [{"type": "VCPU", "value": str(cpus)}]
    values = [
        {"name": name, "value": value} for name, value in {"MUSTER_ON_CHILD_FAILURE": "fail", **variables}.items()
    ]
    container = {"command": ["true"], "resourceRequirements": needs, "environment": values}
    return {"numNodes": nodes, "mainNode": 0, "nodeRangeProperties": [{"targetNodes": "0:", "container": container}]}


class FakeController(Generic[E]):
    """Its database has a queue ``urgent``, which goes before ``default``."""

    def __init__(self, home: Path, engine: E, stack: ExitStack, store_type: type[RunStore] = RunStore) -> None:
        """``stack`` closes it."""
        self.engine = engine
        engines = EngineSet([engine])
        stack.callback(engines.close)
        (home / "store").mkdir()
        self.store = Store(home / "store").open()
        self.database = Database.at(home)
        stack.callback(self.database.close)
        with self.database.session() as session:
            ensure_compute_environments(session, engines.names)
            session.add(JobQueue(name="urgent", priority=9, compute_environments=["fake"]))
        peers = Peers(self.store, home)
        runs = store_type(self.store, peers)
        self.controller = Controller(self.database, engines, self.store, Bus(home, {}), peers, interval=0.02, runs=runs)
        stack.callback(self.controller.close)

    def submit(self, *names: str, **facts: Any) -> None:
        with self.database.session() as session:
            session.add_all(job(name, status=Status.RUNNABLE, **facts) for name in names)
        self.controller.work_queue.alarm.set()

    def job(self, name: str) -> Job:
        with self.database.session() as session:
            return session.get_one(Job, name)

    def wait(self, name: str, *requested: Status) -> Job:
        found: Job = wait_for(lambda: (j := self.job(name)).status in requested and j, 30, f"{name} is {requested}")
        return found

    def ticks(self, condition: Callable[[], bool]) -> None:
        """Make passes until the condition holds."""

        def holds() -> bool:
            self.controller.tick()
            return condition()

        wait_for(holds, 30, "the state")

    def explains(self, name: str, output: str) -> None:
        """Wait until a job's reason, as every answer shows it, has these words."""

        def reason() -> str:
            found = self.job(name)
            return self.controller.admission.reason(found).words

        wait_for(lambda: output in reason(), 30, f"{name} says {output!r}")

    def runs_and_ends(self, *names: str) -> None:
        """Submit jobs, and have them end well once they run."""
        self.submit(*names)
        for name in names:
            self.wait(name, Status.RUNNING)
            for index in range(2):
                done = Outcome(index, 1, 0, None, "done", None, 1.0, 2.0)
                write_outcome(self.store.run(name), name, 1, done)
                self.engine.cluster.end(f"{name}/1/1", index, 0)
        for name in names:
            self.wait(name, Status.SUCCEEDED)
