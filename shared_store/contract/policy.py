"""The policy contract: a policy's inputs and outputs, as a document that needs none of Muster's other code.

It suffices to rebuild the observations of a robot, term by term, and to turn the policy's actions into inputs of its actuators. It is
``contract.json`` of a run and of an exported bundle, and ``contract`` of a checkpoint's manifest. Shapes leave the batch out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from shared_store.contract.documents import DocumentError, parse

FORMAT = 4
"""Version of the document; a newer one is refused."""
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
    """The effect of a choice on the joints, the same joints for each choice; empty: it is not a choice, or the task does not declare it."""


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
    """SHA-256 of ``elements``; of a USD file, of further values of its model, too."""
    mass: float
    """Total mass [kg]."""
    joints: int
    """Number of joints, a free root among them."""
    actuators: int
    """Number of actuators in the file."""
    elements: Mapping[str, Mapping[str, float | str]] = dataclasses.field(default_factory=dict)
    """By kind and name, such as ``body pole``, what its file says of each element, rounded, in SI units: numbers, words, and several
    numbers as words. Those that are 0 are left out. Empty: unknown."""


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


def _plain(value: Any) -> Any:
    """The value after a round trip through JSON: lists for tuples, and no infinity."""
    if isinstance(value, float) and math.isinf(value):
        return math.copysign(LARGEST, value)
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
