"""The car's action space, as in DeepRacer's ``model_metadata.json``. Imported without numpy and torch."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shared_store.contract.error_text import Refused, nearest, shown

STEERING = (-30.0, 30.0)
"""Least and greatest steering angle [degrees], to the left greater than 0."""
CHOICES = (2, 30)
"""Fewest and most actions of a discrete space."""
SPEED = (0.1, 4.0)
"""Least and greatest speed [m/s]."""
TYPES = ("discrete", "continuous")
"""Of action spaces."""
CAMERA = "FRONT_FACING_CAMERA"
CAMERAS = (CAMERA, "STEREO_CAMERAS", "LEFT_CAMERA", "observation")
"""DeepRacer's cameras, of which a car has one; the simulated car has the first, and the last is its name in the oldest files."""
_LEFT_OUT = {"STEREO_CAMERAS": "; its policy sees no depth from two images", "LEFT_CAMERA": ", in its middle"}
"""What notes say of the cameras that the simulated car does not have."""
LIDARS = {
    "LIDAR": {"sectors": 64, "rays": 1, "levels": 0},
    "SECTOR_LIDAR": {"sectors": 8, "rays": 8, "levels": 1},
    "DISCRETIZED_SECTOR_LIDAR": {"sectors": 8, "rays": 8, "levels": 8},
}
"""DeepRacer's lidars, and what each is of the settings of a task's ``lidar``."""
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
        algorithm: Name of the algorithm for which the file was made, such as ``ppo``; None: it names none.
        notes: A line for each kind of value that the simulated car does not have exactly so.
    """

    steering: tuple[float, float]
    speed: tuple[float, float]
    choices: tuple[tuple[float, float], ...] = ()
    lidar: str | None = None
    algorithm: str | None = field(default=None, compare=False)
    notes: tuple[str, ...] = field(default=(), compare=False)

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
    """The action space of what a ``model_metadata.json`` holds, or of a list of actions alone, as older files have it.

    Angles and speeds out of range are clipped, as DeepRacer's simulator does. Network and version are the job's matter and are not
    looked at.

    Raises:
        Refused: It has no actions, a value is not a number, or a sensor is unknown.
    """
    if isinstance(content, Sequence) and not isinstance(content, str):
        content = {"action_space": content}
    if not isinstance(content, Mapping):
        raise Refused((), f"expected an object with action_space and action_space_type, found {shown(content)}")
    lidar, cameras = _sensors(content.get("sensor", [CAMERA]))
    if "action_space" not in content:
        raise Refused((), f"action_space is missing; {nearest('action_space', list(map(str, content)))}")
    space = content["action_space"]
    usual = "continuous" if isinstance(space, Mapping) else "discrete"
    kind = _lower(content.get("action_space_type", usual))
    if kind not in TYPES:
        raise Refused(("action_space_type",), f"there is no type {shown(kind)}; {nearest(str(kind), list(TYPES))}")
    if kind != usual:
        found = "a list of actions" if usual == "discrete" else "a mapping of ranges"
        raise Refused(
            ("action_space_type",), f"it is {kind}, and action_space is {found if space else 'empty'}; they must fit"
        )
    actions = _continuous(space) if kind == "continuous" else _discrete(space)
    meant = _lower(content.get("training_algorithm"))
    algorithm = next((name for name, theirs in ALGORITHMS.items() if theirs == meant), None)
    return replace(actions, lidar=lidar, algorithm=algorithm, notes=(*actions.notes, *cameras))


def _lower(text: Any) -> Any:
    return text.lower().strip() if isinstance(text, str) else text


def _sensors(sensors: Any) -> tuple[str | None, list[str]]:
    """The lidar among the sensors, all of which are checked, and a note for a camera that the simulated car does not have."""
    if isinstance(sensors, str) or not isinstance(sensors, Sequence):
        raise Refused(("sensor",), f"expected a list such as [{CAMERA}], found {shown(sensors)}")
    for number, sensor in enumerate(sensors):
        if not isinstance(sensor, str) or sensor not in (*CAMERAS, *LIDARS):
            names = ", ".join((CAMERA, *LIDARS))
            raise Refused(("sensor", number), f"DeepRacer knows no sensor {shown(sensor)}; use {names}")
    for kind, known in (("camera", CAMERAS), ("lidar", LIDARS)):
        several = [sensor for sensor in sensors if sensor in known]
        if len(several) > 1:
            raise Refused(("sensor",), f"a car has one {kind}, and there are {' and '.join(several)}")
    cameras = [
        f"the simulated car has one front camera in the place of {sensor}{_LEFT_OUT[sensor]}"
        for sensor in sensors
        if sensor in _LEFT_OUT
    ]
    return next((sensor for sensor in sensors if sensor in LIDARS), None), cameras


def _discrete(space: Any) -> ActionSpace:
    is_list = isinstance(space, Sequence) and not isinstance(space, str)
    if not is_list or not CHOICES[0] <= len(space) <= CHOICES[1]:
        found = f"found {len(space)}, which AWS refuses, too" if is_list else f"found {shown(space)}"
        raise Refused(("action_space",), f"expected a list of {CHOICES[0]} to {CHOICES[1]} actions, {found}")
    requested = []
    for number, action in enumerate(space):
        where = ("action_space", number)
        _check_keys(where, action, ("steering_angle", "speed"))
        requested.append(
            (
                _number((*where, "steering_angle"), action["steering_angle"], "degrees"),
                _number((*where, "speed"), action["speed"], "m/s"),
            )
        )
    steerings, speeds = zip(*requested, strict=True)
    clipped = (
        ([abs(angle) > STEERING[1] for angle in steerings], "a steering angle beyond", STEERING[1], "degrees", "steer"),
        ([speed > SPEED[1] for speed in speeds], "a speed above", SPEED[1], "m/s", "drive"),
        ([speed < SPEED[0] for speed in speeds], "a speed below", SPEED[0], "m/s", "drive"),
    )
    notes = tuple(
        f"1 action has {what} {limit:g} {unit} and {does}s {limit:g}"
        if sum(which) == 1
        else f"{sum(which)} actions have {what} {limit:g} {unit} and {does} {limit:g}"
        for which, what, limit, unit, does in clipped
        if any(which)
    )
    choices = tuple((_clipped(angle, STEERING), _clipped(speed, SPEED)) for angle, speed in requested)
    steerings, speeds = zip(*choices, strict=True)
    return ActionSpace((min(steerings), max(steerings)), (min(speeds), max(speeds)), choices, notes=notes)


def _continuous(space: Any) -> ActionSpace:
    _check_keys(("action_space",), space, ("steering_angle", "speed"))
    notes: list[str] = []
    steering = _range("steering_angle", space["steering_angle"], STEERING, "degrees", notes)
    return ActionSpace(steering, _range("speed", space["speed"], SPEED, "m/s", notes), notes=tuple(notes))


def _range(name: str, ends: Any, limits: tuple[float, float], unit: str, notes: list[str]) -> tuple[float, float]:
    """The ends within the limits, with a note for one that is clipped."""
    where = ("action_space", name)
    _check_keys(where, ends, ("low", "high"))
    requested = [_number((*where, end), ends[end], unit) for end in ("low", "high")]
    low, high = (_clipped(each, limits) for each in requested)
    if low >= high:
        wrong = f"low is {requested[0]:g} and high is {requested[1]:g}"
        if requested[0] < requested[1]:
            raise Refused(where, f"{wrong}; the car's range is {limits[0]:g} to {limits[1]:g} {unit}")
        raise Refused(where, f"{wrong}; low must be less")
    for end, each, becomes in zip(("low", "high"), requested, (low, high), strict=True):
        if becomes != each:
            notes.append(f"{name}.{end} is {each:g} {unit}, out of the car's range, and becomes {becomes:g}")
    return low, high


def _check_keys(where: tuple[str | int, ...], value: Any, keys: Sequence[str]) -> None:
    """Refuse all but a mapping with these keys; others beside them, such as ``index``, are not looked at."""
    if not isinstance(value, Mapping):
        raise Refused(where, f"expected an object of {', '.join(keys)}, found {shown(value)}")
    missing = [key for key in keys if key not in value]
    for key in value if missing else ():
        if key not in (*keys, "index"):
            raise Refused(where, f"there is no key {shown(key)}; {nearest(str(key), missing)}")
    if missing:
        raise Refused(where, f"{missing[0]} is missing")


def _number(where: tuple[str | int, ...], value: Any, unit: str) -> float:
    try:  # exported files have numbers as texts, too
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise Refused(where, f"expected a number [{unit}], found {shown(value)}")
    return number


def _clipped(number: float, limits: tuple[float, float]) -> float:
    return min(max(number, limits[0]), limits[1])
