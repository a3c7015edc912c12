"""The policy contract: a policy's inputs and outputs, as a document that needs none of Muster's other code.

It suffices to rebuild the observations of a robot, term by term, and to turn the policy's actions into inputs of its actuators. It is
``contract.json`` of a run and of an exported bundle, and ``contract`` of a checkpoint's manifest. Shapes leave the batch out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from shared_store.documents import DocumentError, parse

FORMAT = 4
"""Version of the document; a newer one is refused."""
CLOSE = 1e-6
"""Relative difference up to which two numbers count as equal: recompiling a model rounds."""
LARGEST = 3.4028234663852886e38
"""Stands for infinity: the greatest 32-bit float."""

Pair = tuple[float, float]


class _Part:
    """Base of the contract's parts; the texts under their fields become JSON Schema descriptions."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"use_attribute_docstrings": True, "extra": "forbid"}


@dataclass(frozen=True)
class Frame(_Part):
    """A frame on a body of the robot in which a vector is measured."""

    name: str
    """Name of the site or body."""
    body: str
    """Its body."""
    position: tuple[float, float, float]
    """Position of its origin in the body's frame [m]."""
    rotation: tuple[float, float, float, float]
    """Rotation from it to the body's frame, a quaternion xyzw."""
    root: bool
    """Whether the body is the robot's root."""


@dataclass(frozen=True)
class Term(_Part):
    """Consecutive numbers of an observation, each ``scale * clip(quantity - offset)``, in this order."""

    name: str
    """Name of the term in its task."""
    kind: Literal["measured", "command", "previous_action"]
    """Its source: sensors, the operator, or the policy itself (its last actions, clipped)."""
    first: int
    """Index of its first number in the group."""
    names: tuple[str, ...]
    """Names of the numbers of one step."""
    units: tuple[str, ...]
    """Unit of each quantity, before the scale; ``1`` for a ratio. Empty: the task declares only the number's name."""
    scale: tuple[float, ...]
    """Factor of each [1/unit]."""
    offset: tuple[float, ...]
    """Value of each quantity that the policy sees as 0 [unit]."""
    clip: Pair | None = None
    """Limits of ``quantity - offset``, before the scale [unit]; null: not limited."""
    ranges: tuple[Pair | None, ...] = ()
    """Least and greatest value of each number of a command in training [unit]; null: unknown. Empty if it is not a command."""
    history: int = 1
    """Observed control steps: ``history * len(names)`` numbers, the oldest step first. Before an episode's first step, its first
    values."""
    delay: tuple[int, int] = (0, 0)
    """Least and greatest delay in training [control steps]."""
    quantity: str = ""
    """Name of the function that computes it, in Muster's library of terms or in the task; empty: not declared."""
    parameters: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    """Numbers of that function."""
    robot: str = ""
    """Name of its robot or object; empty: not declared."""
    element: Literal["", "joint", "body", "site", "index", "action"] = ""
    """Kind of the ``elements``, for each of which the function is called once; empty: it is called once."""
    elements: tuple[str, ...] = ()
    """Names of these joints, bodies, sites or actions, or of the sensor's rows, in order."""
    sensors: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Sensors that it reads, each with its kind and mounting."""
    command: str = ""
    """Name of the command that it shows."""
    library: bool = False
    """Whether ``quantity`` is a function of Muster's library, so that its name says what it computes."""
    frame: Frame | None = None
    """Origin and axes of the measurement, for a quantity of the robot's root or of a sensor; null: unknown or not applicable."""

    @property
    def size(self) -> int:
        """Numbers in the group, with its history."""
        return len(self.names) * self.history


@dataclass(frozen=True)
class Image(_Part):
    """Images as bytes, channels first; the present frame comes first."""

    channels: tuple[str, ...]
    """Channels of one frame, in order."""
    frames: int
    """Number of frames: the present one and those of the control steps before."""
    camera: Mapping[str, Any]
    """Settings of the camera: its place [m, rad], its field of view [rad], its size [px]."""
    scaling: str = "none: the policy takes the bytes, 0 to 255, and scales them itself"
    """Scaling of the bytes before the policy."""


@dataclass(frozen=True)
class Group(_Part):
    """One input of the policy: numbers by terms, or images."""

    name: str
    """Name of the observation group."""
    input: str
    """Name of the input in the exported file."""
    shape: tuple[int, ...]
    """Shape of one observation: one dimension, or channels, height, width."""
    dtype: Literal["float32", "uint8"]
    """Of its elements."""
    terms: tuple[Term, ...] = ()
    """Its numbers, in order; empty for images, and if the task does not declare them."""
    image: Image | None = None
    """Its images."""


@dataclass(frozen=True)
class Target(_Part):
    """The effect of a choice on one joint."""

    joint: str
    """Name of the joint."""
    kind: Literal["effort", "position", "velocity"]
    """Kind of the actuator's input, as of an action."""
    unit: str
    """Unit of the input: N, N m, m, rad, m/s or rad/s."""
    value: float
    """The input [unit]."""


@dataclass(frozen=True)
class Action(_Part):
    """One number of a policy's output: the actuator's input is ``offset + scale * action``, after clipping the action to ``clip``."""

    name: str
    """Name of the joint; for a choice, its own; for a frame that inverse kinematics moves, its name and the axis."""
    kind: Literal["effort", "position", "velocity", "choice"]
    """Whether the input is a force or torque, or the target of a position or velocity controller in the actuator; a choice is one of
    several actions, of which the policy selects one. For a moved frame, the inputs are position targets."""
    unit: str
    """Unit of the input: N, N m, m, rad, m/s or rad/s."""
    scale: float
    """Input that an action of 1 adds [unit]."""
    default_position: float
    """Position of the joint at the start of an episode, before random offsets [m, rad]."""
    offset: float = 0.0
    """Input at an action of 0 [unit]."""
    clip: Pair | None = (-1.0, 1.0)
    """Limits of the action; null: not limited."""
    stiffness: float = 0.0
    """Gain on the error of the position [N/m, N m/rad]."""
    damping: float = 0.0
    """Damping gain on the velocity [N s/m, N m s/rad]."""
    effort_limit: float | None = None
    """Greatest force or torque of the actuator [N, N m]; null: not limited."""
    range: Pair | None = None
    """Least and greatest position of the joint [m, rad]; null: not limited, or unknown."""
    rule: str = ""
    """The rule by which the input follows from ``value = offset + scale * action``, in words; empty: it is the value itself."""
    targets: tuple[Target, ...] = ()
    """The effect of a choice on the joints, the same joints for each choice; empty: it is no choice, or the task does not declare it."""


@dataclass(frozen=True)
class Command(_Part):
    """A command of the operator."""

    name: str
    """Name of the command in its task."""
    names: tuple[str, ...]
    """Names of its numbers, in order."""
    units: tuple[str, ...]
    """Of each."""
    ranges: tuple[Pair | None, ...]
    """Least and greatest value of each in training [unit]; null: unknown."""
    seconds: Pair
    """Least and greatest duration in training [s]."""
    quantity: str = ""
    """Name of the function that draws it; empty: not declared."""
    library: bool = False
    """Whether that is a function of Muster's library."""


@dataclass(frozen=True)
class State(_Part):
    """A part of a recurrent policy's state: zeros when an episode begins, then the output of the step before."""

    name: str
    """Of the input."""
    output: str
    """Name of the output that is the next step's input."""
    shape: tuple[int, ...]
    """Shape without the batch, which is the first dimension."""


@dataclass(frozen=True)
class RobotModel(_Part):
    """A robot of the task, as its file says."""

    name: str
    """Its name in the task."""
    digest: str
    """SHA-256 of the numbers of its compiled model, each rounded."""
    mass: float
    """Total mass [kg]."""
    joints: int
    """Number of joints, a free root among them."""
    actuators: int
    """Number of actuators in the file."""


@dataclass(frozen=True)
class Contract(_Part):
    """The policy contract."""

    task: str
    """Name of the task, or module:Class."""
    muster: str
    """Version of the program that wrote it."""
    control_hz: float
    """Rate at which the policy acts [1/s]."""
    groups: tuple[Group, ...]
    """The policy's inputs, in order."""
    actions: tuple[Action, ...]
    """Its output ``actions``, in order; with choices, the output is one number, the index of the choice. Empty: not declared."""
    action_names: tuple[str, ...]
    """Names of the actions, or of the choices."""
    commands: tuple[Command, ...] = ()
    """The commands that it follows."""
    states: tuple[State, ...] = ()
    """Its recurrent state, in the order of the inputs after the groups."""
    discrete: bool = False
    """Whether an action is one of several choices."""
    robots: tuple[RobotModel, ...] = ()
    """The robots of the task as they were loaded; empty: unknown."""
    normalizer: Literal["inside", "unknown"] = "inside"
    """Inside: the policy takes observations as described here, and contains their normalisation. Unknown: the algorithm does not
    declare how it exports its policy, so the inputs are all groups of the task."""
    format: int = FORMAT
    """Version of the document."""

    def document(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        found: dict[str, Any] = _plain(dataclasses.asdict(self))
        return found

    def group(self, name: str) -> Group | None:
        """The group of that name; None if the policy does not see it."""
        return next((group for group in self.groups if group.name == name), None)


def read(document: Any, where: str = "contract.json") -> Contract:
    """A contract from the document of :meth:`Contract.document`.

    Args:
        document: Plain values.
        where: Its name in errors.

    Raises:
        DocumentError: It is not a contract, or a newer one; one line with the place of the error.
    """
    if isinstance(document, Mapping) and isinstance(version := document.get("format"), int) and version > FORMAT:
        raise DocumentError(f"{where}: has format {version}, this Muster reads up to {FORMAT}; upgrade Muster")
    contract: Contract = parse(Contract, document, where)
    for group in contract.groups:
        here = f"{where}: groups.{group.name}"
        _check_terms(group, here)
    if contract.actions and contract.action_names != tuple(action.name for action in contract.actions):
        raise DocumentError(f"{where}: action_names are not the names of actions, in order")
    return contract


def _check_terms(group: Group, here: str) -> None:
    first = 0
    for term in group.terms:
        lengths = {len(term.units), len(term.scale), len(term.offset), len(term.ranges) or len(term.names)}
        if lengths != {len(term.names)}:
            raise DocumentError(f"{here}.{term.name}: names, units, scale, offset and ranges have different lengths")
        if term.history < 1 or term.first != first:
            raise DocumentError(f"{here}.{term.name}: begins at {term.first}, and the terms before it end at {first}")
        first += term.size
    if group.terms and (first,) != group.shape:
        raise DocumentError(f"{here}: its terms have {first} numbers, its shape is {list(group.shape)}")


def differences(before: Contract, now: Contract, *, ranges: bool = False) -> list[str]:
    """The points in which a policy of ``before`` would misunderstand ``now``, one line each; empty if both mean the same.

    Args:
        before: The contract of the policy's training.
        now: The contract that it would meet.
        ranges: Also compare properties of the training: ranges and durations of commands, delays.
    """
    lines = []
    if before.control_hz != now.control_hz:
        lines.append(f"the control rate {before.control_hz:g} Hz became {now.control_hz:g} Hz")
    for group in before.groups:
        there = now.group(group.name)
        if there is None:
            lines.append(f"the observation group {group.name} is gone")
        else:
            lines += _group_differences(group, there, ranges)
    lines += [f"the observation group {group.name} is new" for group in now.groups if not before.group(group.name)]
    lines += _named(_actions(before), _actions(now), "action")
    lines += _command_differences(before, now, ranges)
    old, new = ({state.name: state.shape for state in each.states} for each in (before, now))
    if old != new:
        lines.append(f"the recurrent state {_states(old)} became {_states(new)}")
    return lines


def robot_changes(before: Contract, now: Contract) -> list[str]:
    """The robots that load otherwise than in a policy's training, one line each; empty if the contract of then knows none."""
    there = {robot.name: robot for robot in before.robots}
    lines = []
    for robot in now.robots:
        then = there.get(robot.name)
        if then is None or then.digest == robot.digest:
            continue
        pairs = (
            ("mass [kg]", then.mass, robot.mass),
            ("joints", then.joints, robot.joints),
            ("actuators", then.actuators, robot.actuators),
        )
        changed = [f"{what} {old:g} became {new:g}" for what, old, new in pairs if old != new]
        lines.append(f"{robot.name}: {', '.join(changed) or 'the values of its compiled model changed'}")
    return lines


def brief(lines: Sequence[str], most: int = 5) -> str:
    """The first differences in one line, and the number of further ones."""
    more = f"; and {len(lines) - most} more" if len(lines) > most else ""
    return "; ".join(lines[:most]) + more


def _group_differences(before: Group, now: Group, ranges: bool) -> list[str]:
    of = "" if before.name == "policy" else f" of {before.name}"
    lines = []
    if before.terms and now.terms:
        lines = _named(_columns(before, ranges), _columns(now, ranges), f"observation{of}")
    if before.image and now.image:
        old, new = (_flat(dataclasses.asdict(each)) for each in (before.image, now.image))
        lines += [f"image{of}: {line}" for line in _changed(old, new)]
    if not lines and (before.shape, before.dtype) != (now.shape, now.dtype):
        lines.append(
            f"the observations{of} of shape {list(before.shape)}, {before.dtype}, became {list(now.shape)}, {now.dtype}"
        )
    return lines


def _columns(group: Group, ranges: bool) -> dict[str, dict[str, Any]]:
    """The meaning of each number of a group, by its label, in order."""
    found = {}
    for term in group.terms:
        common: dict[str, Any] = {
            "kind": term.kind,
            "clip": term.clip,
            "quantity": term.quantity,
            "robot": term.robot,
            "command": term.command,
            **{f"parameter {name}": value for name, value in term.parameters.items()},
            **{f"sensor {name}": value for name, value in term.sensors.items()},
            "frame": term.frame and (term.frame.body, *term.frame.position, *term.frame.rotation),
        }
        if ranges:
            common["delay"] = term.delay
        each = len(term.names) // len(term.elements) if term.elements else 0
        for back in range(term.history - 1, -1, -1):
            for index, name in enumerate(term.names):
                label = name if name == term.name else f"{term.name}/{name}"
                found[f"{label} ({back} steps ago)" if back else label] = {
                    **common,
                    "unit": term.units[index],
                    "scale": term.scale[index],
                    "offset": term.offset[index],
                    **({"element": term.elements[index // each]} if each else {}),
                    **({"range": term.ranges[index]} if ranges and term.ranges else {}),
                }
    return found


def _actions(contract: Contract) -> dict[str, dict[str, Any]]:
    if not contract.actions:
        return {name: {} for name in contract.action_names}
    fields = [field.name for field in dataclasses.fields(Action) if field.name not in ("name", "range")]
    return {action.name: {name: getattr(action, name) for name in fields} for action in contract.actions}


def _command_differences(before: Contract, now: Contract, ranges: bool) -> list[str]:
    old, new = ({each.name: each for each in contract.commands} for contract in (before, now))
    lines = [f"the command {name} is gone" for name in old.keys() - new.keys()]
    lines += [f"the command {name} is new" for name in new.keys() - old.keys()]
    for name in sorted(old.keys() & new.keys()):
        compared = ["names", "units", *(["ranges", "seconds"] if ranges else [])]
        pairs = [{each: getattr(command, each) for each in compared} for command in (old[name], new[name])]
        lines += [f"command {name}: {line}" for line in _changed(*pairs)]
    return sorted(lines)


def _named(before: dict[str, dict[str, Any]], now: dict[str, dict[str, Any]], what: str) -> list[str]:
    """The changes of ordered, named items: ``observation 12: joint_pos/left_knee scale 1 became 0.5``."""
    old, new = list(before), list(now)
    lines = [f"{what} {old.index(name)}: {name} is gone" for name in old if name not in now]
    lines += [f"{what} {new.index(name)}: {name} is new" for name in new if name not in before]
    if not lines:  # otherwise all later items have moved
        moved = [(name, new.index(name)) for index, name in enumerate(old) if new[index] != name]
        lines = [f"{what} {old.index(name)}: {name} became {what} {place}" for name, place in moved]
    for index, name in enumerate(old):
        if name in now:
            lines += [f"{what} {index}: {name} {line}" for line in _changed(before[name], now[name])]
    return lines


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    for name in {**before, **now}:
        old, new = before.get(name), now.get(name)
        if (name in before) != (name in now):
            yield f"{name} {_value(new if name in now else old)} is {'new' if name in now else 'gone'}"
        elif (name == "frame" and None in (old, new)) or (name == "targets" and () in (old, new)):
            continue  # a contract of format 1, or 2, lacks it
        elif not _same(old, new):
            yield f"{name} {_value(old)} became {_value(new)}"


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float | int) and isinstance(other, float | int):
        one, other = (min(max(each, -LARGEST), LARGEST) for each in (one, other))
        return math.isclose(one, other, rel_tol=CLOSE, abs_tol=CLOSE * 1e-3)
    return bool(one == other)


def _value(value: Any) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if value is None or value == "":
        return "none"
    return str(value)


def _states(states: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{name} {list(shape)}" for name, shape in states.items()) or "none"


def _flat(value: Mapping[str, Any]) -> dict[str, Any]:
    """The mapping, with the entries of ``camera`` beside the others."""
    return {**{name: each for name, each in value.items() if name != "camera"}, **value["camera"]}


def _plain(value: Any) -> Any:
    """The value after a round trip through JSON: lists for tuples, and no infinity."""
    if isinstance(value, float) and math.isinf(value):
        return math.copysign(LARGEST, value)
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
