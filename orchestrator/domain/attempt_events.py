"""What happens to an attempt: the events of :func:`orchestrator.domain.attempt.step`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from orchestrator.domain.job import NodeEnd


@dataclass(frozen=True)
class Silence:
    """That the bus does not hear a node that it knew."""

    seconds: float
    since: str
    """When it was heard last, for people."""
    is_lost: bool
    """Whether that proves that the node is lost; else it is unreachable, and waited for."""
    cause: str = ""
    """Why it may be the controller that is cut off; empty where it is not."""


@dataclass(frozen=True)
class Due:
    """It is time to go on with the attempt."""


@dataclass(frozen=True)
class Prepared:
    """The run belongs to the attempt."""

    epoch: int


@dataclass(frozen=True)
class Launched:
    handle: str


@dataclass(frozen=True)
class StartRefused:
    """The run can't be used, or the engine does not start the gang."""

    reason: str
    is_final: bool = True
    """Whether that stays so; else this attempt has failed, and another one may start."""


@dataclass(frozen=True)
class Preempted:
    """The scheduler needs the resources for another job."""

    reason: str


@dataclass(frozen=True)
class Observed:
    """The gang was observed."""

    moment: int
    """Steady time [ms]."""
    ends: Sequence[NodeEnd | None]
    """By node index; None for a node that has not ended, or whose end is not known yet."""
    silences: Sequence[Silence | None]
    """By node index; None for a node that the bus hears, or never knew, and for one that has ended."""
    unread: str | None = None
    """Why it is not known how nodes have ended; empty while that is being read, None where it is known."""
    waits: str = ""
    """Why the main node does not run yet or can't be seen; empty once it runs, or has ended and its end is known."""
    words: str = ""
    """What the engine says of a main node that runs."""
    stale: str = ""
    """Why this is an older status; empty where it is current."""


@dataclass(frozen=True)
class Delayed:
    """What was asked of the store or the engine has to wait: it does not answer, or can't do it now; that is tried again."""

    reason: str
    """Empty where there is nothing to say yet."""
    idle: bool = False
    """Whether nothing that was asked for is under way, so that the attempt may be taken back or end."""


@dataclass(frozen=True)
class Gone:
    """Nothing of the gang runs any more."""

    moment: int
    """Steady time [ms]."""
    ends: Sequence[NodeEnd | None]
    """By node index; empty for a gang that was never launched."""
    progress: str
    """The last checkpoint, as a part of a reason; empty where there is none."""
    cancelled: str = ""
    """How others than Muster ended the gang in its engine's own queue, in words; empty where nobody did."""
    cancellations: int = 0
    """How often the job is started again after that."""


Event = Due | Prepared | Launched | StartRefused | Delayed | Preempted | Observed | Gone
