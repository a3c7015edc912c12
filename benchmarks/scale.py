"""What the controller costs with thousands of gangs, on an engine that starts nothing; and with real processes.

    python -m benchmarks.scale running [--gangs 5000]    # idle, and how soon a stop takes effect
    python -m benchmarks.scale gang [--nodes 5000]       # one large gang: idle, and a restart after a node's end
    python -m benchmarks.scale durable [--gangs 3000]    # gangs of one node, started and ended: store and database on this disk
    python -m benchmarks.scale memory [--gangs 10000]    # the same with the store in memory
    python -m benchmarks.scale real [--gangs 200]        # processes on this machine: what a supervisor costs

Processor time is that of the whole process, so of the submission and the fake engine, too. A loaded machine is refused: :mod:`benchmarks.load`.
"""

from __future__ import annotations

import argparse
import contextlib
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from benchmarks.load import Watch, add_option, own_seconds
from orchestrator.control.bus import Bus
from orchestrator.control.compute_environments import ensure_compute_environments
from orchestrator.control.controller import Controller
from orchestrator.control.peers import Peers
from orchestrator.control.run_store import ObservedRun, RunContent, RunStore
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.engines.api import Engine, Gang, Handle, Plan, Traits
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import Job, now
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import Database
from shared_store.volume.epoch import Claim
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import Outcome, write_outcome

E = TypeVar("E", bound=Engine)

SUBMITTED_AT_ONCE = 500
IDLE = 20.0
"""Seconds for which an idle controller is watched."""


class MemoryStore(RunStore):
    """A store that keeps a run's name and epoch alone; every node that has ended has left 0."""

    epochs: ClassVar[dict[str, int]] = {}
    """By run."""

    def examine(self, name: str) -> ObservedRun:
        epoch = self.epochs.get(name, 0)
        return ObservedRun(name, missing=not epoch, content={} if epoch else None, epoch=epoch)

    def claim(self, name: str, description: Mapping[str, Any], after: int, claim: Claim, texts: Any = ()) -> int:
        self.epochs[name] = after + 1
        return after + 1

    def outcomes(self, name: str, job: str, attempt: int, nodes: Sequence[int]) -> Mapping[int, Outcome]:
        return {index: done(index, attempt) for index in nodes}

    def progress(self, name: str, epoch: int) -> RunContent:
        return RunContent()

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
class Bench(Generic[E]):
    """A controller, and what it works with."""

    home: Path
    controller: Controller
    database: Database
    engine: E
    watch: Watch

    def submit(
        self, count: int, nodes: int = 1, attempts: int = 1, first: int = 0, command: Sequence[str] = ("true",)
    ) -> None:
        """Insert jobs as a request does."""
        shared = [{"name": "MUSTER_ON_CHILD_FAILURE", "value": "restart"}]
        container = {
            "command": list(command),
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
        self.controller.work_queue.alarm.set()

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
            queued_since=now(),
        )

    def have(self, count: int, *states: str) -> bool:
        """Whether so many jobs are in these states."""
        counts = self.database.counts.by_status()
        return sum(counts.get(state, 0) for state in states) == count

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


@contextmanager
def controller(
    engine: E, store_type: type[RunStore], watch: Watch, retention: float | None = None
) -> Iterator[Bench[E]]:
    """A controller that runs, on a database in a folder of its own; ``retention``: seconds for which jobs are kept."""
    MemoryStore.epochs.clear()
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
        bus = Bus(home, {})
        if isinstance(engine, LocalEngine):
            bus.open()
            stack.callback(bus.close)
        runs = store_type(store, peers)
        controller = Controller(database, engines, store, bus, peers, runs=runs, retention=retention)
        stack.callback(controller.close)
        controller.start()
        yield Bench(home, controller, database, engine, watch)


def is_stopped(engine: FakeEngine, gang: str) -> bool:
    return not engine.cluster.gangs[gang][0].running


def is_newest_other(engine: FakeEngine, gang: str) -> bool:
    """Whether another gang was launched since this one."""
    return next(reversed(engine.cluster.gangs)) != gang


def large(gangs: int) -> Hosts:
    """Hosts with room for so many gangs of one core."""
    return Hosts([Host(f"fake/h{number}", 64.0, (), 64 * 1024) for number in range(gangs // 64 + 1)])


def running(count: int, watch: Watch) -> None:
    """Gangs that run: idle, and a stop."""
    with controller(FakeEngine(capacity=large(count)), MemoryStore, watch) as bench:
        began, used = time.monotonic(), time.process_time()
        bench.submit(count)
        bench.wait(partial(bench.have, count, Status.RUNNING), "all run")
        print(
            f"{count} gangs run after {time.monotonic() - began:.1f} s, {time.process_time() - used:.1f} s of CPU",
            flush=True,
        )
        print(f"idle: {100 * bench.idle():.2f} % of a core", flush=True)
        for number, name in enumerate((f"job-{count // 2:06d}", "job-000001", f"job-{count - 1:06d}")):
            began, used = time.monotonic(), time.process_time()
            with bench.database.session() as session:
                ask_to_end(session, Job.id == name, "stopped by the benchmark")
            gang = f"{name}/1/1"
            bench.wait(partial(is_stopped, bench.engine, gang), "stopped", pause=0.002)
            taken = time.monotonic() - began
            bench.wait(partial(bench.have, 1 + number, *TERMINAL), "ended", pause=0.02)
            print(f"a stop reaches the engine after {taken:.3f} s; CPU {time.process_time() - used:.3f} s", flush=True)
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


def gang(nodes: int, watch: Watch) -> None:
    """One gang of many nodes: idle, and a restart."""
    with controller(FakeEngine(capacity=large(nodes)), WithoutOutcomes, watch) as bench:
        bench.submit(1, nodes=nodes, attempts=9)
        bench.wait(partial(bench.have, 1, Status.RUNNING), "it runs")
        print(f"idle: {100 * bench.idle():.2f} % of a core", flush=True)
        for attempt in (1, 2, 3):
            began, used = time.monotonic(), time.process_time()
            name = next(reversed(bench.engine.cluster.gangs))
            bench.engine.cluster.end(name, nodes // 2, 137)
            bench.wait(partial(is_newest_other, bench.engine, name), "launched anew", pause=0.01)
            print(
                f"restart {attempt}: {time.monotonic() - began:.2f} s, CPU {time.process_time() - used:.2f} s",
                flush=True,
            )
            bench.wait(partial(bench.have, 1, Status.RUNNING), "it runs")
            time.sleep(2.0)


def short(count: int, watch: Watch, *, durable: bool) -> None:
    """Gangs of one node that end at once."""
    engine = ShortEngine(capacity=large(2000))
    engine.writes = durable
    with controller(engine, RunStore if durable else MemoryStore, watch) as bench:
        for first, more in ((0, count // 10), (count // 10, count)):  # the first warm up
            began, used = time.monotonic(), time.process_time()
            bench.submit(more, first=first)
            bench.wait(partial(bench.have, first + more, *TERMINAL), "all have ended")
            wall, cpu = time.monotonic() - began, time.process_time() - used
            print(f"{more} gangs: {more / wall:.0f} a second; CPU {1000 * cpu / more:.2f} ms each", flush=True)
        assert bench.have(count + count // 10, Status.SUCCEEDED)


def real(count: int, watch: Watch) -> None:
    """Nodes that sleep, as processes of this machine in gangs of ten."""
    with tempfile.TemporaryDirectory() as folder:
        engine = LocalEngine(Path(folder), cpus=float(count))
        with controller(engine, RunStore, watch) as bench:
            began = time.monotonic()
            bench.submit(count // 10, nodes=10, command=["sleep", "3600"])
            bench.wait(partial(bench.have, count // 10, Status.RUNNING), "all run")
            print(f"{count} nodes run after {time.monotonic() - began:.1f} s", flush=True)
            time.sleep(10.0)
            began, used, all_used = time.monotonic(), time.process_time(), own_seconds()
            time.sleep(IDLE)
            passed, own = time.monotonic() - began, time.process_time() - used
            nodes = own_seconds() - all_used - own
            print(f"idle: controller {100 * own / passed:.2f} % of a core, all nodes {100 * nodes / passed:.1f} %")
            for kind, sizes in proportional_memory().items():
                print(f"{len(sizes)} × {kind}: {sum(sizes) / len(sizes) / 1024:.1f} MiB each (proportional)")
            began = time.monotonic()
            with bench.database.session() as session:
                ask_to_end(session, Job.status == Status.RUNNING, "stopped by the benchmark")
            bench.wait(partial(bench.have, count // 10, *TERMINAL), "all have ended")
            print(f"all {count} nodes are stopped after {time.monotonic() - began:.1f} s")


def proportional_memory() -> dict[str, list[int]]:
    """Proportional set sizes [KiB] of the processes below this one, by kind."""
    found: dict[str, list[int]] = {}
    for process in below("self"):
        with contextlib.suppress(OSError):
            words = (Path("/proc") / process / "cmdline").read_bytes().split(b"\0")
            kind = next(
                (name for name in ("supervisor", "shim") if any(name.encode() in word for word in words)), "other"
            )
            lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
            found.setdefault(kind, []).append(next(int(line.split()[1]) for line in lines if line.startswith("Pss:")))
    return found


def below(process: str) -> Iterator[str]:
    """Ids of the processes that a process, or one below it, has started."""
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            for child in (thread / "children").read_text().split():
                yield child
                yield from below(child)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("running", "gang", "durable", "memory", "real"))
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
        case "real":
            real(options.gangs or 200, watch)
        case part:
            short(options.gangs or (3000 if part == "durable" else 10000), watch, durable=part == "durable")


if __name__ == "__main__":
    main()
