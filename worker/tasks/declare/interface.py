"""The interface of a policy to a robot, as data: each observation and action with its unit, scale and offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from shared_store.contract.policy import Action


@dataclass(frozen=True)
class Observation:
    """One number that a policy sees: ``scale * (quantity - offset)``."""

    name: str
    unit: str = "1"
    """Unit of the quantity, before the scale; ``"1"`` for a ratio."""
    scale: float = 1.0
    """Factor [1/unit]."""
    offset: float = 0.0
    """Value of the quantity that the policy sees as 0 [unit]."""
    kind: Literal["measured", "command", "previous_action"] = "measured"
    """Its source: a sensor, the operator, or the policy itself (its last action, clipped)."""
    range: tuple[float, float] | None = None
    """Least and greatest value of a command in training [unit]."""
    clip: tuple[float, float] | None = None
    """Limits of ``quantity - offset`` before the scale [unit]; None: not limited."""
    back: int = 0
    """Age in control steps, for observations with history. Before an episode's first step, the first value stands in."""


@dataclass(frozen=True)
class Interface:
    """Observations and actions of a policy, in order."""

    observations: tuple[Observation, ...]
    actions: tuple[Action, ...]
