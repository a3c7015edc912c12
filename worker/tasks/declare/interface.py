"""The interface of a policy to a robot, as data: each observation and action with its unit, scale and offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Literal

from shared_store.contract.error_text import nearest
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


def motor(model: Any, actuator: int, name: str, unit: str, default_position: float) -> Action:
    """A motor of ``model`` (MuJoCo's); the action, its input, is a fraction of its full force or torque."""
    full = float(model.actuator_gear[actuator, 0] * model.actuator_gainprm[actuator, 0])
    return Action(name, "effort", unit, scale=full, default_position=default_position, effort_limit=abs(full))


def servo(model: Any, actuator: int, name: str, unit: str, default_position: float, scale: float) -> Action:
    """A position controller of ``model`` (MuJoCo's); the action moves its target away from the default position."""
    limited = bool(model.actuator_forcelimited[actuator])
    return Action(
        name,
        "position",
        unit,
        scale=scale,
        default_position=default_position,
        offset=default_position,
        stiffness=float(model.actuator_gainprm[actuator, 0]),
        damping=-float(model.actuator_biasprm[actuator, 2]),
        effort_limit=float(model.actuator_forcerange[actuator, 1]) if limited else None,
    )


def deviations(noise: float | Mapping[str, float], observations: tuple[Observation, ...]) -> list[float]:
    """Standard deviation of the noise on each observation, in the policy's units. Only measured observations are noisy.

    Args:
        noise: As :attr:`worker.settings.task.Randomization.observation_noise`.
        observations: Of the task.

    Raises:
        ValueError: A name fits no observation that is measured.
    """
    if not isinstance(noise, Mapping):
        return [float(noise) if seen.kind == "measured" else 0.0 for seen in observations]
    found = [0.0] * len(observations)
    measured = [index for index, seen in enumerate(observations) if seen.kind == "measured"]
    for pattern, deviation in noise.items():
        fitting = [index for index in measured if fnmatchcase(observations[index].name, pattern)]
        if not fitting:
            names = [observations[index].name for index in measured]
            raise ValueError(f"no observation that is measured is called {pattern!r}; {nearest(pattern, names)}")
        for index in fitting:
            found[index] = deviation * abs(observations[index].scale)
    return found
