"""The car's action space, as in DeepRacer's ``model_metadata.json``. Imported without numpy and torch."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from shared_store.wording import Refused, nearest, shown

STEERING = (-30.0, 30.0)
"""Least and greatest steering angle [degrees], to the left greater than 0."""
CHOICES = (2, 30)
"""Fewest and most actions of a discrete space."""
SPEED = {"discrete": (0.1, 4.0), "continuous": (0.5, 4.0)}
"""Least and greatest speed of each type of space [m/s]."""
CAMERA = "FRONT_FACING_CAMERA"
LIDARS = {
    "LIDAR": {"sectors": 64, "rays": 1, "levels": 0},
    "SECTOR_LIDAR": {"sectors": 8, "rays": 8, "levels": 1},
    "DISCRETIZED_SECTOR_LIDAR": {"sectors": 8, "rays": 8, "levels": 8},
}
"""DeepRacer's lidars, and what each is of the settings of a task's ``lidar``."""
SENSORS = {CAMERA: True, **dict.fromkeys(LIDARS, True), "STEREO_CAMERAS": False, "LEFT_CAMERA": False}
"""DeepRacer's sensors, and whether the simulated car has them."""
ALGORITHMS = {"ppo": "clipped_ppo", "sac": "sac"}
"""DeepRacer's names of algorithms."""
LARGEST = 1 << 20
"""Bytes of a file."""


@dataclass(frozen=True)
class ActionSpace:
    """An action space.

    Attributes:
        steering: Least and greatest steering angle [degrees].
        speed: Least and greatest speed [m/s].
        choices: Steering angle [degrees] and speed [m/s] of each action, in order; empty where the space is continuous.
        lidar: Name of the lidar among the sensors; None: there is none.
    """

    steering: tuple[float, float]
    speed: tuple[float, float]
    choices: tuple[tuple[float, float], ...] = ()
    lidar: str | None = None

    def metadata(self, sensors: Sequence[str], algorithm: str) -> dict[str, Any]:
        """The content of ``model_metadata.json`` for a policy with these actions.

        Args:
            sensors: By DeepRacer's names.
            algorithm: Name of the algorithm that has learnt it; one that DeepRacer does not know is left out.
        """
        ends = {"steering_angle": self.steering, "speed": self.speed}
        actions = [{"steering_angle": steering, "speed": speed} for steering, speed in self.choices]
        return {
            "action_space": actions or {name: {"low": low, "high": high} for name, (low, high) in ends.items()},
            "action_space_type": "discrete" if actions else "continuous",
            "sensor": list(sensors),
            **({"training_algorithm": ALGORITHMS[algorithm]} if algorithm in ALGORITHMS else {}),
            "version": "5",
        }

    @property
    def radians(self) -> list[tuple[float, float]]:
        """Steering angle [rad] and speed [m/s] of each choice."""
        return [(math.radians(steering), speed) for steering, speed in self.choices]

    @property
    def names(self) -> list[str]:
        """A name for each choice, such as ``0: 30 degrees, 0.6 m/s``."""
        return [f"{number}: {angle:g} degrees, {speed:g} m/s" for number, (angle, speed) in enumerate(self.choices)]


def read_metadata(file: Path) -> ActionSpace:
    """The action space of a ``model_metadata.json``.

    Raises:
        Refused: The file can't be read, or it has none; the message names the file.
    """
    try:
        with file.open("rb") as stream:
            data = stream.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise Refused((), f"it has more than {LARGEST >> 20} MiB, which no action space needs")
        content = json.loads(data)
    except OSError as error:
        raise Refused((), f"{file}: it can't be read ({error.strerror or error})") from None
    except (ValueError, RecursionError) as error:
        words = (
            error.words if isinstance(error, Refused) else "it is not JSON; write it as DeepRacer's model_metadata.json"
        )
        raise Refused((), f"{file}: {words}") from None
    try:
        return action_space(content)
    except Refused as error:
        place = ".".join(map(str, error.path))
        raise Refused((), f"{file}: {place + ': ' if place else ''}{error.words}") from None


def action_space(content: Any) -> ActionSpace:
    """The action space of what a ``model_metadata.json`` holds. Network, algorithm and version are the job's matter and are not looked at.

    Raises:
        Refused: It has none, an action is out of range, or the car does not have a sensor.
    """
    if not isinstance(content, Mapping):
        raise Refused((), f"expected a mapping with action_space and action_space_type, found {shown(content)}")
    lidar = _lidar_of(content.get("sensor", [CAMERA]))
    if "action_space" not in content:
        raise Refused((), f"action_space is missing; {nearest('action_space', list(map(str, content)))}")
    space = content["action_space"]
    usual = "continuous" if isinstance(space, Mapping) else "discrete"
    kind = content.get("action_space_type", usual)
    if kind not in SPEED:
        raise Refused(("action_space_type",), f"there is no type {shown(kind)}; {nearest(str(kind), list(SPEED))}")
    if kind != usual:
        found = "a list of actions" if usual == "discrete" else "a mapping of ranges"
        raise Refused(
            ("action_space_type",), f"it is {kind}, and action_space is {found if space else 'empty'}; they must fit"
        )
    return replace(_continuous(space) if kind == "continuous" else _discrete(space), lidar=lidar)


def _lidar_of(sensors: Any) -> str | None:
    """The lidar among the sensors, all of which are checked."""
    if isinstance(sensors, str) or not isinstance(sensors, Sequence):
        raise Refused(("sensor",), f"expected a list such as [FRONT_FACING_CAMERA], found {shown(sensors)}")
    for number, sensor in enumerate(sensors):
        if not SENSORS.get(sensor if isinstance(sensor, str) else ""):
            there = [name for name, has in SENSORS.items() if has]
            what = "the simulated car does not have" if sensor in SENSORS else "DeepRacer knows no sensor"
            raise Refused(("sensor", number), f"{what} {shown(sensor)}; use {', '.join(there)}")
    lidars = [sensor for sensor in sensors if sensor in LIDARS]
    if len(lidars) > 1:
        raise Refused(("sensor",), f"a car has one lidar, and there are {' and '.join(lidars)}")
    return lidars[0] if lidars else None


def _discrete(space: Any) -> ActionSpace:
    if isinstance(space, str) or not isinstance(space, Sequence) or not CHOICES[0] <= len(space) <= CHOICES[1]:
        found = (
            f"found {len(space)}"
            if isinstance(space, Sequence) and not isinstance(space, str)
            else f"found {shown(space)}"
        )
        raise Refused(("action_space",), f"expected a list of {CHOICES[0]} to {CHOICES[1]} actions, {found}")
    choices = []
    for number, action in enumerate(space):
        where = ("action_space", number)
        _check_keys(where, action, ("steering_angle", "speed", "index"))
        steering = _number((*where, "steering_angle"), action["steering_angle"], STEERING, "degrees")
        choices.append((steering, _number((*where, "speed"), action["speed"], SPEED["discrete"], "m/s")))
    steerings, speeds = zip(*choices, strict=True)
    return ActionSpace((min(steerings), max(steerings)), (min(speeds), max(speeds)), tuple(choices))


def _continuous(space: Any) -> ActionSpace:
    _check_keys(("action_space",), space, ("steering_angle", "speed"))
    steering = _range("steering_angle", space["steering_angle"], STEERING, "degrees")
    return ActionSpace(steering, _range("speed", space["speed"], SPEED["continuous"], "m/s"))


def _range(name: str, ends: Any, limits: tuple[float, float], unit: str) -> tuple[float, float]:
    where = ("action_space", name)
    _check_keys(where, ends, ("low", "high"))
    low, high = (_number((*where, end), ends[end], limits, unit) for end in ("low", "high"))
    if low >= high:
        raise Refused(where, f"low is {low:g} and high is {high:g}; low must be less")
    return low, high


def _check_keys(where: tuple[str | int, ...], value: Any, keys: Sequence[str]) -> None:
    """Refuse what is no mapping of these keys; ``index`` may be missing."""
    if not isinstance(value, Mapping):
        raise Refused(where, f"expected a mapping of {', '.join(keys[:2])}, found {shown(value)}")
    for key in value:
        if key not in keys:
            raise Refused(where, f"there is no key {shown(key)}; {nearest(str(key), list(keys))}")
    for key in keys[:2]:
        if key not in value:
            raise Refused(where, f"{key} is missing")


def _number(where: tuple[str | int, ...], value: Any, limits: tuple[float, float], unit: str) -> float:
    try:  # exported files have numbers as texts, too
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not limits[0] <= number <= limits[1]:
        raise Refused(where, f"expected a number from {limits[0]:g} to {limits[1]:g} [{unit}], found {shown(value)}")
    return number
