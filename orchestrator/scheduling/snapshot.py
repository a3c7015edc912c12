"""What a scheduling pass looks at: jobs, queues, pools, hosts and the clock. Values only.

Times are in milliseconds, on a clock that never steps (:mod:`orchestrator.clock`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from orchestrator.engines.base import Host, Placement


class NodeShape(NamedTuple):
    """What one node takes of its host."""

    cpus: float
    gpus: int
    memory: int
    """MiB."""


@dataclass(frozen=True)
class Shape:
    """What a gang takes; compared by value. Callers share one object between equal jobs, which makes look-ups fast."""

    nodes: tuple[NodeShape, ...]
    """By node index."""
    minimum: int
    """With how few of its first nodes it may start."""
    main: int

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.nodes, self.minimum, self.main))

    @cached_property
    def groups(self) -> tuple[tuple[NodeShape, tuple[int, ...]], ...]:
        """The distinct nodes and their indices, the most demanding first."""
        indices: dict[NodeShape, list[int]] = {}
        for index, node in enumerate(self.nodes):
            indices.setdefault(node, []).append(index)
        ordered = sorted(indices.items(), key=lambda item: (-item[0].gpus, -item[0].cpus, -item[0].memory))
        return tuple((node, tuple(each)) for node, each in ordered)

    @cached_property
    def uses_gpus(self) -> bool:
        """Whether GPUs are what counts when shares are compared; else it is CPUs."""
        return any(node.gpus for node in self.nodes)

    @cached_property
    def demand(self) -> float:
        """GPUs of the whole gang; CPUs where it has none."""
        return float(sum(node.gpus if self.uses_gpus else node.cpus for node in self.nodes))

    @cached_property
    def least(self) -> NodeShape:
        """What the smallest allowed number of nodes takes in all."""
        nodes = self.nodes[: self.minimum]
        return NodeShape(sum(n.cpus for n in nodes), sum(n.gpus for n in nodes), sum(n.memory for n in nodes))


@dataclass(frozen=True, slots=True)
class Waiting:
    """A RUNNABLE job."""

    job: str
    name: str
    queue: str
    shape: Shape
    priority: int
    """0 to 9999, higher first; counts in queues with a fair-share policy."""
    share: str | None
    created_at: int
    since: int
    """When it became RUNNABLE (Unix time [ms]); for people."""
    timeout: int | None
    """Of an attempt [s]."""


@dataclass(frozen=True, slots=True)
class Running:
    """A gang that holds resources, from its launch until no process of it is left."""

    job: str
    name: str
    queue: str
    share: str | None
    priority: int
    pool: str
    placements: tuple[Placement, ...]
    started_at: int | None
    """[ms]; None while it starts."""
    timeout: int | None
    """Of an attempt [s]."""
    preemptible: bool
    ending: bool
    """It is being stopped already: what it holds comes free soon."""


@dataclass(frozen=True)
class Pool:
    """An AWS compute environment: which hosts its jobs may use, and how much of them."""

    name: str
    enabled: bool
    hosts: tuple[str, ...] | None
    """None: all that the engine has."""
    max_cpus: float | None
    engine: str | None = None
    """Only hosts of this one; None: of any."""


@dataclass(frozen=True)
class TimeLimit:
    """Cancel a job that is stuck first in its queue for this reason (``jobStateTimeLimitActions``)."""

    reason: str
    seconds: int


@dataclass(frozen=True)
class FairShare:
    """A fair-share scheduling policy."""

    decay_seconds: int
    reservation: int
    """``computeReservation``, 0 to 99."""
    weights: Mapping[str, float]
    """``weightFactor`` by share, 1.0 where none is given; the lower, the more. A key may end in ``*``: a prefix."""


@dataclass(frozen=True)
class Queue:
    """A job queue."""

    name: str
    priority: int
    pools: tuple[str, ...]
    """Names, in the order in which they are tried."""
    policy: FairShare | None
    """None: first in, first out."""
    limits: tuple[TimeLimit, ...]


@dataclass(frozen=True, slots=True)
class Leading:
    """The first job of a queue that does not start."""

    job: str
    reason: str
    """Code of why (``CAPACITY:…``, ``ACTION_REQUIRED…``)."""
    since: int
    """Since when it is that, for that reason [ms]."""


@dataclass(frozen=True)
class Snapshot:
    """Everything that a pass depends on."""

    now: int
    """[ms]."""
    hosts: Sequence[Host]
    """With all that they have, free or not."""
    pools: Mapping[str, Pool]
    queues: Mapping[str, Queue]
    waiting: Iterable[Waiting]
    """In any order."""
    running: Sequence[Running]
    usage: Mapping[tuple[str, str], float]
    """(queue, share) → resource-seconds, decayed to now; a job without a share counts under the share ``""``."""
    leading: Mapping[str, Leading] = field(default_factory=dict)
    """By queue, of the last pass."""
    drift: int = 0
    """What a time lacks [ms] to be Unix time, as people read it."""
