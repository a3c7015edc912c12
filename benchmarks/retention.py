"""Whether a controller's store and database stay as large as they are, however many jobs go through.

    python -m benchmarks.retention [--jobs 100000] [--rounds 10] [--off]
    python -m benchmarks.retention --rows [--jobs 100000] [--rounds 50]    # rows of jobs that have ended, without runs

Gangs of one node run on an engine that starts nothing (:mod:`benchmarks.scale`): each leaves a run with an outcome and a log, durably on
this disk. Meanwhile one pass of retention follows another, in the steps and with the rests that they always have. After each round a line
shows the contents of the store; with ``--off``, without retention. A loaded machine is refused: :mod:`benchmarks.load`.
"""

from __future__ import annotations

import argparse
import os
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from statistics import quantiles

from sqlalchemy import func, insert, select

from benchmarks.kept import resident
from benchmarks.load import Watch, add_option
from benchmarks.scale import Bench, ShortEngine, controller, large
from orchestrator.control.run_store import RunStore
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.engines.api import Gang, Handle, Plan
from orchestrator.persistence.batch_models import Attempt, Job, Node, RunRecord
from shared_store.volume.layout import Store

_TABLES = (Job, Attempt, Node, RunRecord)
_OPEN = [status for status in Status if status not in TERMINAL]
_LOG = b"a line of a log\n" * 64


class LoggingEngine(ShortEngine):
    """Its gangs leave a log, too."""

    writes = True

    def launch(self, plan: Plan[Gang]) -> Handle:
        gang = plan.gang
        log = Store(gang.store).run(gang.run).log(gang.job, gang.attempt, 0)
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_bytes(_LOG)
        return super().launch(plan)


@dataclass(frozen=True)
class Size:
    """The contents of the store."""

    jobs: int
    rows: int
    """Of all tables that a job adds to."""
    files: int
    """In the store."""
    database: int
    """Bytes of the database, with its write-ahead log."""
    memory: int
    """Bytes of this process."""

    def __str__(self) -> str:
        database, memory = self.database / 2**20, self.memory / 2**20
        return f"{self.jobs:7,} jobs {self.rows:7,} rows {self.files:7,} files {database:7.1f} MiB database {memory:5.0f} MiB memory"


def size(bench: Bench[LoggingEngine]) -> Size:
    with bench.database.session() as session:
        counts = [session.scalar(select(func.count()).select_from(table)) or 0 for table in _TABLES]
    database = sum(path.stat().st_size for path in bench.home.glob("muster.db*"))
    files = sum(len(names) for _, _, names in os.walk(bench.home / "store"))
    return Size(counts[0], sum(counts), files, database, 1024 * resident())


def rounds(bench: Bench[LoggingEngine], jobs: int, count: int, takes: bool = True) -> list[Size]:
    """Jobs through the controller, in so many rounds; the store's contents after each, and after the last pass."""
    found: list[Size] = []
    loop: list[float] = []
    monitoring = bench.controller.monitoring
    took = monitoring.loop.observe

    def note(seconds: float, *_: object) -> None:
        loop.append(seconds)
        took(seconds)

    monitoring.loop.observe = note  # type: ignore[method-assign, assignment]
    each, ending = jobs // count, threading.Event()

    def passes() -> None:
        while not ending.wait(1.0):
            bench.controller.retention.take_all()

    taking = threading.Thread(target=passes, daemon=True)
    trash = bench.home / "store" / "trash"
    if takes:
        taking.start()
    for number in range(count):
        began, used = time.monotonic(), time.process_time()
        loop.clear()
        bench.submit(each, first=number * each)
        bench.wait(lambda: bench.have(0, *_OPEN), "all have ended", 3600.0, pause=0.2)
        seconds = time.monotonic() - began
        if takes:
            bench.wait(
                lambda: bench.have(0, *TERMINAL) and not list(trash.glob("*")), "all are taken", 3600.0, pause=0.2
            )
        left = time.monotonic() - began - seconds
        forget_ended(bench)
        found.append(size(bench))
        slowest = quantiles(loop, n=100)[98] if len(loop) > 1 else 0.0
        print(
            f"{(number + 1) * each:7,} through: {found[-1]}; {each / seconds:4.0f} jobs/s, the last taken {left:4.1f} s later, {time.process_time() - used:5.1f} s of CPU, "
            f"pass of the loop p99 {1000 * slowest:.0f} ms",
            flush=True,
        )
    ending.set()
    if takes:
        taking.join()
    return found


def rows_alone(bench: Bench[LoggingEngine], jobs: int, count: int) -> list[Size]:
    """Insert rows of ended jobs in ``count`` portions; retention takes each portion before the next one."""
    found, each = [], jobs // count
    for number in range(count):
        names = [f"row-{index:07d}" for index in range(number * each, (number + 1) * each)]
        shared = {
            "queue": "default",
            "definition": "bench:1",
            "request": {},
            "status": Status.SUCCEEDED,
            "stopped_at": 1,
        }
        with bench.database.session() as session:
            session.execute(insert(Job), [{**shared, "id": name, "name": name, "run": name} for name in names])
            session.execute(
                insert(Attempt), [{"job_id": name, "number": 1, "epoch": 1, "stopped_at": 1} for name in names]
            )
            session.execute(insert(Node), [{"job_id": name, "attempt": 1, "index": 0, "host": "h"} for name in names])
            session.execute(insert(RunRecord), [{"name": name, "queue": "default"} for name in names])
        used = time.process_time()
        bench.controller.retention.take_all()
        milliseconds = 1000 * (time.process_time() - used) / each
        found.append(size(bench))
        print(f"{(number + 1) * each:7,} through: {found[-1]}; {milliseconds:.2f} ms of CPU a job", flush=True)
    return found


def forget_ended(bench: Bench[LoggingEngine]) -> None:
    """The fake cluster keeps every gang that it had."""
    with suppress(RuntimeError):
        bench.engine.cluster.gangs.clear()
        bench.engine.cluster.launched.clear()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=100_000, help="number of jobs")
    parser.add_argument("--rounds", type=int, default=10, help="number of rounds")
    parser.add_argument("--rows", action="store_true", help="rows of ended jobs alone")
    parser.add_argument("--off", action="store_true", help="take nothing")
    add_option(parser)
    options = parser.parse_args()
    watch = Watch(options.loaded_anyway)
    with controller(LoggingEngine(capacity=large(2000)), RunStore, watch, retention=0.0) as bench:
        if options.rows:
            rows_alone(bench, options.jobs, options.rounds)
        else:
            rounds(bench, options.jobs, options.rounds, not options.off)


if __name__ == "__main__":
    main()
