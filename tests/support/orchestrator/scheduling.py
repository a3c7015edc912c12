"""Jobs, hosts and queues for the scheduler, with what a test does not care about filled in; and what it decided, in short."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement
from orchestrator.domain.resources import Resources
from orchestrator.scheduling.decide import Decisions
from orchestrator.scheduling.snapshot import (
    ComputeEnvironment,
    FairShare,
    Leading,
    Queue,
    Running,
    Snapshot,
    TimeLimit,
    Waiting,
)

NOW = 1_800_000_000_000
"""2027-01-15 08:00:00 UTC [ms]."""
FAIR = FairShare(600, 0, {})


def host(name: str = "a", cpus: float = 4, gpus: int = 0, memory: int = 8192) -> Host:
    return Host(name, cpus, tuple(f"{name}{i}" for i in range(gpus)), memory)


def node(cpus: float = 1, gpus: int = 0, memory: int = 100) -> Resources:
    return Resources(cpus, gpus, memory)


def gang(*nodes: Resources, minimum: int | None = None) -> Shape:
    return Shape(nodes, len(nodes) if minimum is None else minimum, 0)


def job(
    name: str,
    shape: Shape | None = None,
    *,
    queue: str = "default",
    priority: int = 0,
    share: str | None = None,
    age: int = 0,
    runnable: int = 0,
    timeout: int | None = None,
) -> Waiting:
    """A job of one node with one CPU, where nothing else is said; ``age`` and ``runnable`` in seconds."""
    created, since = NOW - 1000 * age, NOW - 1000 * runnable
    return Waiting(f"{name}-0123456789", name, queue, shape or gang(node()), priority, share, created, since, timeout)


def line(*jobs: Waiting) -> list[Waiting]:
    """The jobs as if created one after the other."""
    return [
        Waiting(j.job, j.name, j.queue, j.shape, j.priority, j.share, NOW - 1000 + i, j.since, j.timeout)
        for i, j in enumerate(jobs)
    ]


def running(
    name: str,
    *placements: Placement,
    queue: str = "default",
    share: str | None = None,
    priority: int = 0,
    compute_environment: str = "all",
    for_seconds: int = 100,
    timeout: int | None = None,
    preemptible: bool = False,
    ending: bool = False,
) -> Running:
    started = NOW - 1000 * for_seconds
    return Running(
        f"{name}-0123456789",
        name,
        queue,
        share,
        priority,
        compute_environment,
        placements,
        started,
        timeout,
        preemptible,
        ending,
    )


def on(name: str, cpus: float = 0, gpus: Iterable[int] = (), memory: int = 0) -> Placement:
    return Placement(name, tuple(f"{name}{i}" for i in gpus), cpus, memory)


def queue(
    name: str = "default",
    priority: int = 1,
    compute_environments: tuple[str, ...] = ("all",),
    policy: FairShare | None = None,
    limits: tuple[TimeLimit, ...] = (),
) -> Queue:
    return Queue(name, priority, compute_environments, policy, limits)


def compute_environment(
    name: str = "all", hosts: tuple[str, ...] | None = None, enabled: bool = True, max_cpus: float | None = None
) -> ComputeEnvironment:
    return ComputeEnvironment(name, enabled, hosts, max_cpus)


def snapshot(
    hosts: Sequence[Host],
    waiting: Sequence[Waiting],
    held: Sequence[Running] = (),
    queues: Sequence[Queue] = (),
    compute_environments: Sequence[ComputeEnvironment] = (),
    usage: Mapping[tuple[str, str], float] | None = None,
    leading: Mapping[str, Leading] | None = None,
) -> Snapshot:
    return Snapshot(
        now=NOW,
        hosts=hosts,
        compute_environments={each.name: each for each in compute_environments or [compute_environment()]},
        queues={each.name: each for each in queues or [queue()]},
        waiting=waiting,
        running=held,
        usage=usage or {},
        leading=leading or {},
    )


def leads(name: str, reason: str, seconds: int, queue: str = "default") -> dict[str, Leading]:
    """That job has been first in its queue for so long, for that reason."""
    return {queue: Leading(f"{name}-0123456789", reason, NOW - 1000 * seconds)}


def names(jobs: Iterable[str]) -> str:
    return " ".join(each.removesuffix("-0123456789") for each in jobs)


def started(decisions: Decisions) -> str:
    """Each started job with its hosts, in the order in which they were decided."""
    return " ".join(
        f"{names([start.job])}:{'+'.join(placement.host for placement in start.placements)}"
        for start in decisions.starts
    )


def reason(decisions: Decisions, name: str) -> str:
    return decisions.report.reason(f"{name}-0123456789")
