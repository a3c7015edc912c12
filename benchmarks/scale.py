"""What the controller costs with thousands of gangs, on an engine that starts nothing.

    python -m benchmarks.scale running [--gangs 5000]    # idle, and how soon a stop takes effect
    python -m benchmarks.scale gang [--nodes 5000]       # one large gang: idle, and a restart after a node's end
    python -m benchmarks.scale durable [--gangs 3000]    # gangs of one node, started and ended: store and database on this disk
    python -m benchmarks.scale memory [--gangs 10000]    # the same with the store in memory

Processor time is that of the whole process, so of the fake engine, too. A loaded machine is refused: :mod:`benchmarks.load`.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

from benchmarks.load import Watch, add_option
from orchestrator.control.bus import Bus
from orchestrator.control.compute_environments import ensure_compute_environments
from orchestrator.control.peers import Peers
from orchestrator.control.reconciler import Reconciler
from orchestrator.control.run_store import Progress, RunFacts, RunStore
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.engines.api import Gang, Handle, Plan, Traits
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.models import Job
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import Database
from shared_store.epoch import Claim
from shared_store.layout import Store
from shared_store.outcomes import Outcome, write_outcome

SUBMITTED_AT_ONCE = 500
IDLE = 20.0
"""Seconds for which an idle controller is watched."""


class MemoryStore(RunStore):
    """A store that keeps a run's name and epoch alone; every node that has ended has left 0."""

    def __init__(self, store: Store, peers: Peers) -> None:
        super().__init__(store, peers)
        self._epochs: dict[str, int] = {}

    def examine(self, name: str) -> RunFacts:
        epoch = self._epochs.get(name, 0)
        return RunFacts(name, missing=not epoch, content={} if epoch else None, epoch=epoch)

    def claim(self, name: str, description: Mapping[str, Any], after: int, claim: Claim, texts: Any = ()) -> int:
        self._epochs[name] = after + 1
        return after + 1

    def outcomes(self, name: str, job: str, attempt: int, nodes: Sequence[int]) -> Mapping[int, Outcome]:
        return {index: done(index, attempt) for index in nodes}

    def progress(self, name: str, epoch: int) -> Progress:
        return Progress()

    def release(self, name: str, epoch: int) -> None:
        """Nothing was claimed."""


class WithoutOutcomes(MemoryStore):
    """One in which nodes leave nothing: what the engine reports of their ends counts."""

    def outcomes(self, name: str, job: str, attempt: int, nodes: Sequence[int]) -> Mapping[int, Outcome]:
        return {}


def done(index: int, attempt: int) -> Outcome:
    """The outcome of a node that has left with 0."""
    return Outcome(index, attempt, 0, None, "done", None, 1.0, 2.0)


class ShortEngine(FakeEngine):
    """Its gangs end with 0 as soon as they are started, and leave their outcomes in the store where that is one."""

    traits = Traits(launches=8)
    writes = False

    def launch(self, plan: Plan[Gang]) -> Handle:
        handle, gang = super().launch(plan), plan.gang
        for index in range(len(plan.nodes)):
            if self.writes:
                write_outcome(Store(gang.store).run(gang.run), gang.job, gang.attempt, done(index, gang.attempt))
            self.cluster.end(gang.name, index, 0)
        return handle


@dataclass
class Bench:
    """A controller, and what it works with."""

    reconciler: Reconciler
    database: Database
    engine: FakeEngine
    watch: Watch

    def submit(self, count: int, nodes: int = 1, attempts: int = 1, first: int = 0) -> None:
        """Insert jobs as a request does."""
        shared = [{"name": "MUSTER_ON_CHILD_FAILURE", "value": "restart"}]
        container = {
            "command": ["true"],
            "resourceRequirements": [{"type": "VCPU", "value": "1"}, {"type": "MEMORY", "value": "64"}],
            "environment": shared,
        }
        document = {
            "numNodes": nodes,
            "mainNode": 0,
            "nodeRangeProperties": [{"targetNodes": "0:", "container": container}],
        }
        for start in range(first, first + count, SUBMITTED_AT_ONCE):
            names = [f"job-{number:06d}" for number in range(start, min(first + count, start + SUBMITTED_AT_ONCE))]
            with self.database.session() as session:
                session.add_all(self._row(name, document, nodes, attempts) for name in names)
        self.reconciler.wake()

    @staticmethod
    def _row(name: str, document: dict[str, Any], nodes: int, attempts: int) -> Job:
        return Job(
            id=name,
            name=name,
            queue="default",
            definition="bench:1",
            request={},
            kind="multinode" if nodes > 1 else "container",
            run=name,
            status=Status.RUNNABLE,
            own_node_properties=document,
            attempts_allowed=attempts,
            queued_since=self_now(),
        )

    def count(self, *states: str) -> int:
        with self.database.session() as session:
            return session.scalar(select(func.count()).where(Job.status.in_(states))) or 0

    def wait(self, condition: Callable[[], bool], what: str, seconds: float = 600.0, pause: float = 0.1) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise SystemExit(f"{what}: not within {seconds:.0f} s")
            time.sleep(pause)

    def idle(self) -> float:
        """Share of a core that the process needs while nothing changes."""
        time.sleep(5.0)
        began, used = time.monotonic(), time.process_time()
        time.sleep(IDLE)
        return (time.process_time() - used) / (time.monotonic() - began)


def self_now() -> int:
    """Steady time [ms], as good as the controller's own."""
    return int(time.time() * 1000)


@contextmanager
def controller(engine: FakeEngine, store_type: type[RunStore], watch: Watch) -> Iterator[Bench]:
    """A controller that runs, on a database in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        home = Path(folder)
        (home / "store").mkdir()
        store, engines = Store(home / "store").open(), EngineSet([engine])
        stack.callback(engines.close)
        database = Database.at(home)
        stack.callback(database.close)
        with database.session() as session:
            ensure_compute_environments(session, engines.names)
        peers = Peers(store, home)
        reconciler = Reconciler(database, engines, store, Bus(home), peers, runs=store_type(store, peers))
        stack.callback(reconciler.close)
        reconciler.start()
        yield Bench(reconciler, database, engine, watch)


def large(gangs: int) -> Hosts:
    """Hosts with room for so many gangs of one core."""
    return Hosts([Host(f"fake/h{number}", 64.0, (), 64 * 1024) for number in range(gangs // 64 + 1)])


def running(count: int, watch: Watch) -> None:
    """Gangs that run: idle, and a stop."""
    with controller(FakeEngine(capacity=large(count)), MemoryStore, watch) as bench:
        began, used = time.monotonic(), time.process_time()
        bench.submit(count)
        bench.wait(lambda: bench.count(Status.RUNNING) == count, "all run")
        print(
            f"{count} gangs run after {time.monotonic() - began:.1f} s, {time.process_time() - used:.1f} s of CPU",
            flush=True,
        )
        print(f"idle: {100 * bench.idle():.2f} % of a core", flush=True)
        for name in [f"job-{count // 2:06d}", "job-000001", f"job-{count - 1:06d}"]:
            began, used = time.monotonic(), time.process_time()
            with bench.database.session() as session:
                ask_to_end(session, Job.id == name, "stopped by the benchmark")
            gang = f"{name}/1/1"
            bench.wait(lambda gang=gang: not bench.engine.cluster.gangs[gang][0].running, "stopped", pause=0.002)
            taken = time.monotonic() - began
            bench.wait(lambda: bench.count(*TERMINAL) > 0, "ended", pause=0.02)
            print(f"a stop reaches the engine after {taken:.3f} s; CPU {time.process_time() - used:.3f} s", flush=True)
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


def gang(nodes: int, watch: Watch) -> None:
    """One gang of many nodes: idle, and a restart."""
    with controller(FakeEngine(capacity=large(nodes)), WithoutOutcomes, watch) as bench:
        bench.submit(1, nodes=nodes, attempts=9)
        bench.wait(lambda: bench.count(Status.RUNNING) == 1, "it runs")
        print(f"idle: {100 * bench.idle():.2f} % of a core", flush=True)
        for attempt in (1, 2, 3):
            began, used = time.monotonic(), time.process_time()
            name = next(iter(reversed(bench.engine.cluster.gangs)))
            bench.engine.cluster.end(name, nodes // 2, 137)
            bench.wait(lambda name=name: list(bench.engine.cluster.gangs)[-1] != name, "launched anew", pause=0.01)
            print(
                f"restart {attempt}: {time.monotonic() - began:.2f} s, CPU {time.process_time() - used:.2f} s",
                flush=True,
            )
            bench.wait(lambda: bench.count(Status.RUNNING) == 1, "it runs")
            time.sleep(2.0)


def short(count: int, watch: Watch, *, durable: bool) -> None:
    """Gangs of one node that end at once."""
    engine = ShortEngine(capacity=large(2000))
    engine.writes = durable
    with controller(engine, RunStore if durable else MemoryStore, watch) as bench:
        for first, more in ((0, count // 10), (count // 10, count)):  # the first warm up
            began, used = time.monotonic(), time.process_time()
            bench.submit(more, first=first)
            bench.wait(lambda first=first, more=more: bench.count(*TERMINAL) == first + more, "all have ended")
            wall, cpu = time.monotonic() - began, time.process_time() - used
            print(f"{more} gangs: {more / wall:.0f} a second; CPU {1000 * cpu / more:.2f} ms each", flush=True)
        assert bench.count(Status.SUCCEEDED) == count + count // 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("running", "gang", "durable", "memory"))
    parser.add_argument("--gangs", type=int, help="number of gangs")
    parser.add_argument("--nodes", type=int, default=5000, help="of the one gang")
    add_option(parser)
    options = parser.parse_args()
    watch = Watch(options.loaded_anyway)
    match options.part:
        case "running":
            running(options.gangs or 5000, watch)
        case "gang":
            gang(options.nodes, watch)
        case part:
            short(options.gangs or (3000 if part == "durable" else 10000), watch, durable=part == "durable")


if __name__ == "__main__":
    main()
