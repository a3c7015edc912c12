"""What is struck, with which signal and at which moment: drawn from a seed."""

from __future__ import annotations

import random
from dataclasses import dataclass

SHARES = {"controller": 50, "writer": 24, "rank": 15, "supervisor": 11}
"""Per cent of the blows. A gang that starts costs many CPU seconds, a controller few, a writer hardly any."""
_FREEZES = 0.09
"""Share of SIGSTOP among the blows."""
JOB_NODES = (1, 1, 1, 1, 2, 2, 3)
"""Sizes of the gangs, to choose from."""


@dataclass(frozen=True)
class Blow:
    """One signal to one process."""

    target: str
    """``controller``, ``writer``, ``rank`` or ``supervisor``."""
    freeze: bool
    """SIGSTOP, else SIGKILL."""
    moment: str
    """``any``: ``delay`` after the last blow, while the gang trains. ``commit``: when a hidden checkpoint directory is seen.
    ``start``: while processes start. ``again``: right after the last blow, whatever it has hit."""
    delay: float
    """Seconds from the moment to the blow."""
    pause: float | None
    """Controller: seconds until it is started again. Frozen process: seconds until SIGCONT; None: never."""
    choice: float
    """Which of several processes, in [0, 1)."""

    @property
    def ends_gang(self) -> bool:
        """Whether the gang has to start again after it."""
        return self.target in ("rank", "supervisor") or (self.freeze and self.target == "writer")


@dataclass(frozen=True)
class Plan:
    """One run."""

    seed: str
    """Names the run's random numbers."""
    nodes: int
    attempts: int
    """``retry.attempts``; when they are spent the run is resumed by another job."""
    blows: tuple[Blow, ...]


def draw_plan(seed: str, blows: int) -> Plan:
    """The plan of the run called ``seed``."""
    rng = random.Random(seed)
    nodes = rng.choice(JOB_NODES)
    attempts = rng.choice((2, 4, 10, 10))
    return Plan(seed, nodes, attempts, tuple(_draw(rng) for _ in range(blows)))


def _draw(rng: random.Random) -> Blow:
    target = rng.choices(list(SHARES), list(SHARES.values()))[0]
    freeze = rng.random() < _FREEZES
    if target == "controller":
        moment = rng.choices(("any", "commit", "start", "again"), (50, 15, 15, 20))[0]
        pause: float | None = rng.choice((0.0, 0.0, 0.3, 1.0, 3.0))
        if freeze:
            moment, pause = "any", rng.uniform(0.5, 6.0)
    else:
        moment = rng.choices(("any", "commit", "start", "again"), (45, 35, 10, 10))[0]
        pause = rng.choice((None, rng.uniform(0.2, 2.0), rng.uniform(2.0, 12.0))) if freeze else None
        if freeze:
            moment = "any"
    longest = {"any": 1.5, "commit": 0.008, "start": 2.5, "again": 0.4}[moment]
    delay = rng.choice((0.0, rng.uniform(0.0, longest))) if moment == "commit" else rng.uniform(0.0, longest)
    return Blow(target, freeze, moment, delay, pause, rng.random())
