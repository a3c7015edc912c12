"""What can be set of a task from its job's YAML: times, reward weights, training."""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from worker.learning.ppo.settings import PPOConfig

FACTORS = ("mass", "friction", "damping", "gains", "gravity")
"""Factors on the physics of each world."""
_SCALARS = ("push_interval", "push_velocity")
_SCENE = ("camera_position", "camera_angle", "colors")


@dataclass(frozen=True)
class Randomization:
    """How the worlds of a task differ from one another. Factors are uniform in ``[least, greatest]``, one for each world.

    Raises:
        ValueError: A range is no range, or a number is out of range.
    """

    mass: tuple[float, float] = (1.0, 1.0)
    """Factor on masses and inertias."""
    friction: tuple[float, float] = (1.0, 1.0)
    """Factor on the friction of everything that touches."""
    damping: tuple[float, float] = (1.0, 1.0)
    """Factor on the damping of the joints."""
    gains: tuple[float, float] = (1.0, 1.0)
    """Factor on the strength of the actuators: a motor's torque, a servo's stiffness and damping."""
    gravity: tuple[float, float] = (1.0, 1.0)
    """Factor on gravity."""
    push_interval: float = 0.0
    """Mean simulated time between two pushes of a world, which come at random [s]; 0: none."""
    push_velocity: float = 0.0
    """A push adds velocities uniform in +- this to the robot's, along the world's x and y [m/s]."""
    observation_noise: float | Mapping[str, float] = field(default=0.0, metadata={"by_name": True})
    """Standard deviation of the normal noise on what is measured; the policy's last action and its command stay exact. A number: of
    each observation, as the policy sees it. A mapping: by name of the observation, with ``*`` for any letters, in the unit of the
    measured quantity [m, rad, m/s, rad/s]; where several names fit, the last one counts, and where none does there is no noise."""
    camera_position: float = 0.0
    """Each camera stands up to this far from its place, along each axis [m]."""
    camera_angle: float = 0.0
    """Each camera is turned up to this far about each of its axes [rad]."""
    colors: float = 0.0
    """Red, green and blue of each shape differ by up to this from their usual value, of 1."""
    light: tuple[float, float] = (1.0, 1.0)
    """Factor on the brightness of what a camera sees."""
    action_latency: int = 0
    """Greatest number of control steps by which controls reach the actuators late; each episode draws its own, from 0."""

    @property
    def scene(self) -> list[str]:
        """What is on that only a camera sees."""
        return [name for name in _SCENE if getattr(self, name)] + (["light"] if self.light != (1.0, 1.0) else [])

    @property
    def draws_worlds(self) -> bool:
        """Whether physics or scene of each world are drawn when it is built."""
        return bool(self.scene) or any(getattr(self, name) != (1.0, 1.0) for name in FACTORS)

    def __post_init__(self) -> None:
        for name in (*FACTORS, "light"):
            ends = getattr(self, name)
            pair = isinstance(ends, list | tuple) and len(ends) == 2 and all(_is_finite(end) for end in ends)
            if not pair or not 0.0 <= ends[0] <= ends[1] or (name == "mass" and ends[0] == 0.0):
                least = "above 0" if name == "mass" else "of 0 or more"
                shown = list(ends) if isinstance(ends, tuple) else ends
                raise ValueError(f"{name}: expected [least, greatest], two factors {least}; got {shown!r}")
            object.__setattr__(self, name, (float(ends[0]), float(ends[1])))
        for name in (*_SCALARS, *_SCENE):
            value = getattr(self, name)
            if not _is_finite(value) or value < 0.0:
                raise ValueError(f"{name}: expected a number of 0 or more, got {value!r}")
        noise = self.observation_noise
        for name, value in (noise if isinstance(noise, Mapping) else {"": noise}).items():
            if not _is_finite(value) or value < 0.0:
                where = f"observation_noise.{name}" if name else "observation_noise"
                raise ValueError(f"{where}: expected a number of 0 or more, got {value!r}")
        if not isinstance(self.action_latency, int) or not 0 <= self.action_latency <= 64:
            raise ValueError(
                f"action_latency: expected a whole number of steps from 0 to 64, got {self.action_latency!r}"
            )
        if bool(self.push_interval) != bool(self.push_velocity):
            raise ValueError("push_interval and push_velocity: give both, or none")


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _check_curriculum(curriculum: Mapping[str, Any], terms: Mapping[str, float]) -> None:
    if not isinstance(curriculum, Mapping):
        raise ValueError(f"curriculum: expected a mapping from names to points, got {curriculum!r}")
    for name, points in curriculum.items():
        if name != "level" and name not in terms:
            hint = _hint(name, ["level", *terms])
            raise ValueError(f"curriculum: there is no {name!r}; {hint}there are level, {', '.join(terms)}")
        shaped = isinstance(points, list | tuple) and points and all(isinstance(p, list | tuple) for p in points)
        if not shaped or not all(len(point) == 2 and all(map(_is_finite, point)) for point in points):
            raise ValueError(f"curriculum.{name}: expected points [iteration, value], got {points!r}")
        if any(not float(point[0]).is_integer() or point[0] < 0 for point in points):
            raise ValueError(f"curriculum.{name}: an iteration is a whole number from 0 up, got {points!r}")
        if any(after[0] <= before[0] for before, after in itertools.pairwise(points)):
            raise ValueError(f"curriculum.{name}: the iterations of its points must grow, got {points!r}")
        if name == "level" and not all(0.0 <= value <= 1.0 for _, value in points):
            raise ValueError(f"curriculum.level: expected levels from 0 to 1, got {points!r}")


def value_at(points: Sequence[Sequence[float]], iteration: int) -> float:
    """The value of a curriculum's ``points`` in an iteration, counted from 0."""
    for before, after in itertools.pairwise(points):
        if before[0] <= iteration < after[0]:
            return before[1] + (after[1] - before[1]) * (iteration - before[0]) / (after[0] - before[0])
    return points[0][1] if iteration < points[0][0] else points[-1][1]


def _hint(name: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(name), list(known), n=1)
    return f"did you mean {near[0]}? " if near else ""


def nested(where: str, kind: type[Any], value: Any) -> Any:
    """``value``, or, where it is a mapping of its fields, the ``kind`` of configuration made of it.

    Raises:
        ValueError: A field is unknown or out of range.
    """
    if not isinstance(value, Mapping):
        return value
    try:
        return kind(**value)
    except TypeError as error:
        raise ValueError(f"{where}: {error}") from error


def reward_weights(**weights: float) -> Any:
    """The ``rewards`` field of a task's configuration: its terms in the order of the kernel's indices, with their weights.

    Args:
        **weights: Default weight of each term; that of a cost is negative.
    """
    return field(default_factory=lambda: MappingProxyType(weights))


def default_rewards(config_type: type[TaskConfig]) -> Mapping[str, float]:
    """Terms and weights as ``config_type`` defines them, in the order of the kernel's indices."""
    factory: Any = next(item.default_factory for item in fields(config_type) if item.name == "rewards")
    weights: Mapping[str, float] = factory()
    return weights


@dataclass(frozen=True)
class TaskConfig:
    """What every task has; a task adds its own fields.

    Raises:
        ValueError: ``rewards`` names a term that the task does not have, a weight is not a finite number, or ``randomize``
            is not a mapping of its fields.
    """

    control_hz: float = 60.0
    """Control steps per simulated second [Hz]."""
    substeps: int = 2
    """Physics steps of one control step."""
    episode_seconds: float = 10.0
    """Simulated time after which the clock ends an episode [s]."""
    rewards: Mapping[str, float] = reward_weights()
    """Weight of each reward term. Who gives some names changes those; the others keep the task's defaults."""
    randomize: Randomization = Randomization()
    """How the worlds differ from one another; not at all by default. A mapping of its fields will do."""
    curriculum: Mapping[str, Sequence[Sequence[float]]] = field(default_factory=lambda: MappingProxyType({}))
    """What changes in the course of training: points ``[iteration, value]`` in the order of the iterations, between which the
    value changes in proportion, and outside of which it stays. By the name of a reward term: its weight; ``level``: how hard the
    task is to be, from 0 to 1 (that of pushes and of the Quadruped's commands; a task of one's own reads ``episodes.level``)."""
    fastest: float = 1000.0
    """Velocity of a joint from which on the physics has failed [m/s, rad/s]: the world is reset, as if something were NaN."""
    nan_limit: float = 0.1
    """Training stops when worlds that failed had to be reset more often in one iteration than this, times the number of worlds."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """How the task is trained."""

    def __post_init__(self) -> None:
        known = default_rewards(type(self))
        _check_curriculum(self.curriculum, known)
        if not _is_finite(self.nan_limit) or self.nan_limit < 0.0:
            raise ValueError(f"nan_limit: expected a share of 0 or more, got {self.nan_limit!r}")
        for name, weight in self.rewards.items():
            if name not in known:
                raise ValueError(
                    f"rewards: {type(self).__name__} has no term {name!r}; {_hint(name, known)}its terms are {', '.join(known)}"
                )
            if not _is_finite(weight):
                raise ValueError(f"rewards.{name}: expected a finite number as the weight, got {weight!r}")
        weights = {name: float(self.rewards.get(name, weight)) for name, weight in known.items()}
        object.__setattr__(self, "rewards", MappingProxyType(weights))
        object.__setattr__(self, "randomize", nested("randomize", Randomization, self.randomize))
