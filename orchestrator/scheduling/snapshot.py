"""A snapshot as the input of a scheduling pass: jobs, queues, compute environments, hosts and the clock. Values only.

Times are in milliseconds, on a clock that never steps (:mod:`orchestrator.control.clock`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement


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
    owner: str | None = None
    """The submitter; None without keys."""


@dataclass(frozen=True, slots=True)
class RunningGang:
    """A gang that holds resources, from its launch until no process of it is left."""

    job: str
    name: str
    queue: str
    share: str | None
    priority: int
    compute_environment: str
    placements: tuple[Placement, ...]
    started_at: int | None
    """[ms]; None while it starts."""
    timeout: int | None
    """Of an attempt [s]."""
    preemptible: bool
    ending: bool
    """Whether it is being stopped: its resources come free soon."""


@dataclass(frozen=True)
class ComputeEnvironment:
    """An AWS compute environment: the hosts that its jobs may use, and a limit of CPUs."""

    name: str
    enabled: bool
    hosts: tuple[str, ...] | None
    """None: all of the engine's."""
    max_cpus: float | None
    engine: str | None = None
    """Only hosts of this one; None: of any."""
    unknown: str = ""
    """Why the engine has not reported its hosts yet; empty once it has."""


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
    compute_environments: tuple[str, ...]
    """Names, in the order in which they are tried."""
    policy: FairShare | None
    """None: first in, first out."""
    limits: tuple[TimeLimit, ...]


@dataclass(frozen=True, slots=True)
class Leading:
    """The first job of a queue that does not start."""

    job: str
    reason: str
    """Code of its reason (``CAPACITY:…``, ``ACTION_REQUIRED…``)."""
    since: int
    """Since when it has been first, for that reason [ms]."""


Moment = tuple[int, int]
"""A time [ms], and a number that orders what happened in one pass."""


@dataclass(frozen=True, slots=True)
class QueueHead:
    """The first job of a queue for which there was no room."""

    job: str
    since: Moment


@dataclass(frozen=True)
class RoundRobin:
    """What a pass remembers of those before it, so that owners and queues take turns."""

    served: Mapping[tuple[str, str | None], Moment] = field(default_factory=dict)
    """(queue, owner) → when a job of theirs was started last."""
    heads: Mapping[str, QueueHead] = field(default_factory=dict)
    """By queue."""


@dataclass(frozen=True)
class Snapshot:
    """The whole input of a pass."""

    now: int
    """[ms]."""
    hosts: Sequence[Host]
    """With their full capacity, free or not."""
    compute_environments: Mapping[str, ComputeEnvironment]
    queues: Mapping[str, Queue]
    waiting: Iterable[Waiting]
    """In any order."""
    running: Sequence[RunningGang]
    usage: Mapping[tuple[str, str], float]
    """(queue, share) → resource-seconds, decayed to now; a job without a share counts under the share ``""``."""
    leading: Mapping[str, Leading] = field(default_factory=dict)
    """By queue, of the last pass."""
    turns: RoundRobin = field(default_factory=RoundRobin)
    """As the last pass has left them."""
    drift: int = 0
    """Difference of Unix time to the pass's clock [ms]."""
