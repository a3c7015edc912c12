"""Time of one scheduling pass on a full cluster: ``python -m benchmarks.scheduling`` prints a Markdown table."""

from __future__ import annotations

import gc
import random
import statistics
import sys
import time

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement
from orchestrator.domain.resources import Resources
from orchestrator.scheduling.decisions import decide
from orchestrator.scheduling.snapshot import ComputeEnvironment, FairShare, Queue, RunningGang, Snapshot, Waiting

HOSTS, GPUS = 16, 8
NOW = 1_800_000_000_000
"""Time of the pass [ms]."""
COUNTS = (100, 1_000, 10_000, 100_000)
ONE = Shape((Resources(12, 1, 32768),), 1, 0)


def mixed_shapes() -> list[Shape]:
    """Twenty gangs of 1 to 5 nodes with 1 to 8 GPUs each."""
    each = [(nodes, gpus) for nodes in (1, 2, 3, 4, 5) for gpus in (1, 2, 4, 8)]
    return [Shape((Resources(12 * gpus, gpus, 32768 * gpus),) * nodes, nodes, 0) for nodes, gpus in each]


def cluster() -> tuple[list[Host], list[RunningGang]]:
    """Sixteen hosts with eight GPUs; each GPU is held by its own gang, which ends within a day."""
    hosts = [Host(f"h{i}", 96, tuple(str(k) for k in range(GPUS)), GPUS * 32768) for i in range(HOSTS)]
    running = [
        RunningGang(
            job=f"running-{host.name}-{gpu}",
            name="running",
            queue="default",
            share=f"share{(i + int(gpu)) % 50}",
            priority=0,
            compute_environment="all",
            placements=(Placement(host.name, (gpu,), 12, 32768),),
            started_at=NOW - 1000 * (i * GPUS + int(gpu)),
            timeout=86400,
            preemptible=False,
            ending=False,
        )
        for i, host in enumerate(hosts)
        for gpu in host.gpus
    ]
    return hosts, running


def snapshot(count: int, shapes: list[Shape], policy: FairShare | None) -> Snapshot:
    """``count`` waiting jobs, every second one with a timeout, in random order."""
    draw = random.Random(count)
    waiting = [
        Waiting(
            job=f"{i:08x}-waiting",
            name=f"job{i}",
            queue="default",
            shape=shapes[i % len(shapes)],
            priority=draw.randrange(3),
            share=f"share{draw.randrange(50)}" if policy else None,
            created_at=NOW - draw.randrange(10**8),
            since=NOW,
            timeout=draw.choice([None, draw.randrange(60, 10**6)]),
        )
        for i in range(count)
    ]
    hosts, running = cluster()
    queue = Queue("default", 1, ("all",), policy, ())
    usage = {("default", f"share{i}"): 1000.0 * i for i in range(50)}
    return Snapshot(
        NOW, hosts, {"all": ComputeEnvironment("all", True, None, None)}, {"default": queue}, waiting, running, usage
    )


def measure(each: Snapshot, repeats: int) -> float:
    """Median of several passes [ms]."""
    taken = []
    for _ in range(repeats):
        gc.collect()
        begin = time.perf_counter()
        decide(each)
        taken.append(time.perf_counter() - begin)
    return 1000 * statistics.median(taken)


def main() -> None:
    fair = FairShare(3600, 0, {f"share{i}": 1 + i / 50 for i in range(25)})
    cases: list[tuple[str, list[Shape], FairShare | None]] = [
        ("FIFO, one shape", [ONE], None),
        ("fair share, 50 shares", [ONE], fair),
        ("FIFO, 20 shapes", mixed_shapes(), None),
        ("fair share, 50 shares, 20 shapes", mixed_shapes(), fair),
    ]
    print(f"One pass, {HOSTS} hosts × {GPUS} GPUs, all taken; median [ms], Python {sys.version.split()[0]}\n")
    print(f"| jobs waiting | {' | '.join(f'{count:,}' for count in COUNTS)} |")
    print(f"|---|{'---:|' * len(COUNTS)}")
    for name, shapes, policy in cases:
        times = [measure(snapshot(count, shapes, policy), 15 if count <= 10_000 else 7) for count in COUNTS]
        print(f"| {name} | {' | '.join(f'{each:.1f}' for each in times)} |")
    report = decide(snapshot(10_000, mixed_shapes(), fair)).report
    order = report.order("default")
    begin = time.perf_counter()
    for job in order:
        report.reason(job)
    print(f"\nThe reasons of 10,000 jobs, where all are asked for: {1000 * (time.perf_counter() - begin):.0f} ms.")


if __name__ == "__main__":
    main()
