"""What is to be done for an attempt: the instructions that :func:`orchestrator.domain.attempt.step` gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from orchestrator.domain.job import Status, Verdict


@dataclass(frozen=True)
class Prepare:
    """Create the run where it is missing, and give it to the attempt: → Prepared, Delayed or StartRefused, or nothing yet."""


@dataclass(frozen=True)
class TakeEpoch:
    """Note the attempt's epoch."""

    epoch: int


@dataclass(frozen=True)
class Withdraw:
    """Take the attempt back: it has used nothing, and what it holds is for other jobs until it is tried again."""

    reason: str


@dataclass(frozen=True)
class Launch:
    """Ask the engine to launch the gang, which it does once for an epoch: → Launched, Delayed or StartRefused."""

    again: bool = True
    """Whether to try again where nothing of the gang can run yet."""


@dataclass(frozen=True)
class Keep:
    """Note the handle of the gang."""

    handle: str


@dataclass(frozen=True)
class Observe:
    """Observe the gang: → Observed or Delayed, or nothing before the engine's first poll."""


@dataclass(frozen=True)
class Explain:
    """Give the job this reason."""

    reason: str


@dataclass(frozen=True)
class MarkRunning:
    """The job is RUNNING, for this reason, since this moment (steady time [ms])."""

    reason: str
    moment: int


@dataclass(frozen=True)
class Await:
    """Wait for other nodes since this moment (steady time [ms]): for the one that was the cause, or for children of a main node that is done."""

    what: Literal["cause_since", "done_since"]
    """Where :class:`orchestrator.domain.attempt.AttemptState` has the moment."""
    moment: int


@dataclass(frozen=True)
class Decide:
    """Note how the attempt ends."""

    verdict: Verdict


@dataclass(frozen=True)
class Save:
    """Make what was noted durable before anything else is done."""


@dataclass(frozen=True)
class Stop:
    """Have the gang stopped, unless that is under way: → Delayed or Gone."""

    grace: float
    """Seconds from SIGTERM to SIGKILL."""
    waits: str
    """Why the job has not ended yet, where the stop itself is under way."""


@dataclass(frozen=True)
class WindUp:
    """There is nothing to stop: → Gone."""


@dataclass(frozen=True)
class Close:
    """Close the attempt: account for it and move the job on."""

    moment: int
    """Steady time [ms]."""
    spent: bool
    """Whether it counts against the job's attempts."""
    status: Status
    reason: str
    cancelled: str = ""
    """As in :class:`orchestrator.domain.attempt_events.Gone`, where that ended the attempt."""


Instruction = (
    Prepare
    | TakeEpoch
    | Launch
    | Keep
    | Observe
    | Explain
    | MarkRunning
    | Await
    | Decide
    | Save
    | Stop
    | WindUp
    | Withdraw
    | Close
)
Instructions = tuple[Instruction, ...]
