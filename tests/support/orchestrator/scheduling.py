"""Jobs, hosts and queues for the scheduler, with what a test does not care about filled in; and what it decided, in short."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement
from orchestrator.domain.resources import Resources
from orchestrator.scheduling.decisions import decide
from orchestrator.scheduling.snapshot import (
    ComputeEnvironment,
    FairShare,
    Leading,
    Queue,
    RunningGang,
    Snapshot,
    TimeLimit,
    Waiting,
)

NOW = 1_800_000_000_000
"""2027-01-15 08:00:00 UTC [ms]."""
FAIR = FairShare(600, 0, {})
CAPACITY = "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY"
MAXIMUM = "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE"
REQUIREMENT = "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT"


def host(name: str = "a", cpus: float = 4, gpus: int = 0, memory: int = 8192) -> Host:
    return Host(name, cpus, tuple(f"{name}{i}" for i in range(gpus)), memory)


def node(cpus: float = 1, gpus: int = 0, memory: int = 100) -> Resources:
    return Resources(cpus, gpus, memory)


def gang(*nodes: Resources, minimum: int | None = None) -> Shape:
    return Shape(nodes, len(nodes) if minimum is None else minimum, 0)


def job(
    name: str,
    shape: Shape | float = 1,
    *,
    queue: str = "default",
    priority: int = 0,
    share: str | None = None,
    age: int = 0,
    runnable: int = 0,
    timeout: int | None = None,
    owner: str | None = None,
) -> Waiting:
    """A job; a number as its shape: one node with so many CPUs. ``age`` and ``runnable`` in seconds."""
    whole = shape if isinstance(shape, Shape) else gang(node(shape))
    created, since = NOW - 1000 * age, NOW - 1000 * runnable
    return Waiting(f"{name}-0123456789", name, queue, whole, priority, share, created, since, timeout, owner)


def line(*jobs: Waiting) -> list[Waiting]:
    """The jobs as if created one after the other."""
    return [replace(each, created_at=NOW - 1000 + i) for i, each in enumerate(jobs)]


def running(
    name: str,
    *placements: Placement,
    queue: str = "default",
    share: str | None = None,
    priority: int = 0,
    environment: str = "all",
    for_seconds: int | None = 100,
    timeout: int | None = None,
    preemptible: bool = False,
    ending: bool = False,
) -> RunningGang:
    """A gang; ``for_seconds``: None while it starts."""
    since = None if for_seconds is None else NOW - 1000 * for_seconds
    job = f"{name}-0123456789"
    return RunningGang(job, name, queue, share, priority, environment, placements, since, timeout, preemptible, ending)


def on(name: str, cpus: float = 0, gpus: Iterable[int] = (), memory: int = 0) -> Placement:
    return Placement(name, tuple(f"{name}{i}" for i in gpus), cpus, memory)


def queue(
    name: str = "default",
    priority: int = 1,
    environments: tuple[str, ...] = ("all",),
    policy: FairShare | None = None,
    limits: tuple[TimeLimit, ...] = (),
) -> Queue:
    return Queue(name, priority, environments, policy, limits)


def environment(
    name: str = "all", hosts: tuple[str, ...] | None = None, enabled: bool = True, max_cpus: float | None = None
) -> ComputeEnvironment:
    return ComputeEnvironment(name, enabled, hosts, max_cpus)


class Pass:
    """A pass of the scheduler, and what it decided, in short."""

    def __init__(
        self,
        hosts: Sequence[Host],
        waiting: Sequence[Waiting] = (),
        held: Sequence[RunningGang] = (),
        queues: Sequence[Queue] = (),
        environments: Sequence[ComputeEnvironment] = (),
        usage: Mapping[tuple[str, str], float] | None = None,
        leading: Mapping[str, Leading] | None = None,
    ) -> None:
        known = {each.name: each for each in environments or [environment()]}
        lines = {each.name: each for each in queues or [queue()]}
        snapshot = Snapshot(NOW, hosts, known, lines, waiting, held, usage or {}, leading or {})
        self.decisions = decide(snapshot)
        self.starts, self.preempts = self.decisions.starts, self.decisions.preempts
        self.cancels = self.decisions.cancels
        self.started = " ".join(f"{_short(each.job)}:{_hosts(each.placements)}" for each in self.starts)
        """Each started job with its hosts, in the order in which they were decided."""
        self.preempted = " ".join(_short(each.job) for each in self.preempts)
        self.cancelled = " ".join(_short(each.job) for each in self.cancels)

    def waits(self, queue: str = "default") -> str:
        """The jobs that still wait, in the order of their queue."""
        return " ".join(_short(each) for each in self.decisions.report.order(queue))

    def reason(self, name: str) -> str:
        """In the AWS Batch API."""
        return self.decisions.report.reason(f"{name}-0123456789").aws


def leads(name: str, reason: str, seconds: int, queue: str = "default") -> dict[str, Leading]:
    """That job has been first in its queue for so long, for that reason."""
    return {queue: Leading(f"{name}-0123456789", reason, NOW - 1000 * seconds)}


def needs(cpus: float, gpus: int = 0, nodes: int = 1, least: str = "") -> str:
    """A reason's words for what a gang needs in all, with 100 MiB a node."""
    words = f"{nodes} node{'s' * (nodes > 1)} with {cpus} CPU{'s' * (cpus != 1)}, {gpus} GPU{'s' * (gpus != 1)}"
    return f"needs {least}{words}, {100 * nodes} MiB in all"


def seats(each: Resources, hosts: Iterable[Host]) -> int:
    """How many such nodes fit: reckoned by division, apart from the scheduler."""
    return sum(
        min(
            int((free.cpus + 1e-9) // each.cpus),
            len(free.gpus) // each.gpus if each.gpus else 99,
            free.memory // each.memory,
        )
        for free in hosts
    )


def _short(job: str) -> str:
    return job.removesuffix("-0123456789")


def _hosts(placements: Iterable[Placement]) -> str:
    return "+".join(each.host for each in placements)
