"""What the controller keeps in memory of jobs that have ended: gangs of one node on an engine that starts nothing.

    python -m benchmarks.kept [--gangs 10000]

Its memory is measured after the first 2,000, when its caches are full, and at the end. A loaded machine is refused: :mod:`benchmarks.load`.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from pathlib import Path

from benchmarks.load import Watch, add_option
from benchmarks.scale import Bench, MemoryStore, ShortEngine, controller, large

FIRST, AT_ONCE = 2000, 100
SETTLED = 5.0
"""Seconds after which the controller has forgotten the last jobs."""


def resident() -> int:
    """Resident memory of this process [kB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def kept() -> tuple[int, int]:
    """Resident memory [kB], and the number of objects, once the controller rests."""
    time.sleep(SETTLED)
    gc.collect()
    return resident(), len(gc.get_objects())


def end_gangs(bench: Bench[ShortEngine], first: int, last: int) -> None:
    """Let the gangs of these numbers start and end, some at once; the engine forgets them, as a real one does."""
    queue = bench.controller.work_queue
    for start in range(first, last, AT_ONCE):
        bench.submit(AT_ONCE, first=start)
        bench.wait(lambda: not (queue.waiting() or queue.active()), "all have ended", pause=0.02)
        bench.engine.cluster.gangs.clear()
        bench.engine.cluster.launched.clear()
        MemoryStore.epochs.clear()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gangs", type=int, default=10_000, help="number of gangs")
    add_option(parser)
    options = parser.parse_args()
    watch = Watch(options.loaded_anyway)
    with controller(ShortEngine(capacity=large(AT_ONCE)), MemoryStore, watch) as bench:
        end_gangs(bench, 0, FIRST)
        before, objects = kept()
        end_gangs(bench, FIRST, options.gangs)
        after, more = kept()
        count = options.gangs - FIRST
        print(f"after {FIRST} gangs {before / 1024:.0f} MiB; {count} more: ", end="")
        print(f"{(after - before) / count:.2f} kB and {(more - objects) / count:.2f} objects each")


if __name__ == "__main__":
    main()
