"""A number of a task that adapts to the policy's performance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Adaptive:
    """A number that adapts to the policy's performance: the same in all worlds of all ranks, and part of a run's state.

    Before each iteration it goes one step from ``start`` towards ``end`` if the mean of the episodes that ended last is above
    ``above``, and one step back if it is below ``below``. An evaluation of a checkpoint uses the training's value.

    Args:
        place: Place of the number, such as ``events.push.speed``; at a place with several numbers, all change.
        start: Its first value.
        end: Its last value.
        steps: Number of steps between the two.
        above: Mean above which it takes a step forward.
        below: Mean below which it takes a step back; None: never.
        of: The quantity of the mean, ``"return"`` or ``"length"`` [steps].
    """

    place: str
    start: float
    end: float
    steps: int = 20
    above: float = 0.0
    below: float | None = None
    of: Literal["return", "length"] = "return"

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"Adaptive of {self.place}: steps is {self.steps}; use 1 or more")
        if self.below is not None and self.below >= self.above:
            raise ValueError(
                f"Adaptive of {self.place}: below is {self.below}, which must be less than above, {self.above}"
            )
        if self.of not in ("return", "length"):
            raise ValueError(f"Adaptive of {self.place}: of is {self.of!r}; it is return or length")

    def after(self, step: float, reward: float | None, episode_length: float | None) -> float:
        """The step, from 0 to :attr:`steps`, that follows ``step``."""
        mean = reward if self.of == "return" else episode_length
        if mean is None:
            return step
        moved = step + (mean > self.above) - (self.below is not None and mean < self.below)
        return min(max(moved, 0.0), float(self.steps))

    def value(self, step: float) -> float:
        """The number at a step."""
        return self.start + (self.end - self.start) * step / self.steps
