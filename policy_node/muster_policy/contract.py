"""The node's view of a bundle's ``contract.json``: the policy's inputs and outputs, term by term."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from muster_policy.errors import Refused

FORMAT = 4
"""The newest version of the document that the node reads."""
Pair = tuple[float, float]


@dataclass(frozen=True)
class Frame:
    """A frame on a body of the robot.

    Attributes:
        name: Of the site or body.
        body: The body that it is on.
        position: Of its origin in the body's frame [m], shape ``(3,)``.
        rotation: From it to the body's frame, a quaternion xyzw, shape ``(4,)``.
        root: Whether the body is the robot's root.
    """

    name: str
    body: str
    position: tuple[float, ...]
    rotation: tuple[float, ...]
    root: bool


@dataclass(frozen=True)
class Term:
    """Some numbers of an observation: ``scale * clip(quantity - offset)``; fields as in Muster's policy contract."""

    name: str
    kind: str
    names: tuple[str, ...]
    scale: np.ndarray
    offset: np.ndarray
    clip: Pair | None
    history: int
    quantity: str
    parameters: Mapping[str, Sequence[float]]
    element: str
    elements: tuple[str, ...]
    sensors: Mapping[str, str]
    command: str
    library: bool = False
    frame: Frame | None = None

    @property
    def size(self) -> int:
        """Numbers in the group, with its history."""
        return len(self.names) * self.history


@dataclass(frozen=True)
class Image:
    """Frames of a camera as bytes, the present one first."""

    channels: tuple[str, ...]
    frames: int


@dataclass(frozen=True)
class Group:
    """One input of the policy: numbers by terms, or images."""

    name: str
    input: str
    shape: tuple[int, ...]
    dtype: str
    terms: tuple[Term, ...]
    image: Image | None


@dataclass(frozen=True)
class Target:
    """The value of one joint's command for a choice [unit]."""

    joint: str
    kind: str
    unit: str
    value: float


@dataclass(frozen=True)
class Action:
    """One number that the policy asks for: the joint's command is ``offset + scale * clip(action)``."""

    name: str
    kind: str
    unit: str
    scale: float
    offset: float
    clip: Pair | None
    default_position: float
    stiffness: float
    damping: float
    effort_limit: float | None
    rule: str
    range: Pair | None = None
    targets: tuple[Target, ...] = ()
    """Of a choice."""


@dataclass(frozen=True)
class Command:
    """The operator's command."""

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    ranges: tuple[Pair | None, ...]
    quantity: str = ""
    library: bool = False


@dataclass(frozen=True)
class State:
    """A part of what a recurrent policy remembers."""

    name: str
    output: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Contract:
    """Everything that the node needs of it."""

    task: str
    format: int
    control_hz: float
    groups: tuple[Group, ...]
    actions: tuple[Action, ...]
    action_names: tuple[str, ...]
    commands: tuple[Command, ...]
    states: tuple[State, ...]
    discrete: bool

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that the policy reads or drives."""
        names = [action.name for action in self.actions if action.kind != "choice"]
        names += [target.joint for action in self.actions for target in action.targets]
        for group in self.groups:
            names += [joint for term in group.terms if term.element == "joint" for joint in term.elements]
        return tuple(dict.fromkeys(names))

    def command(self, name: str) -> Command | None:
        """The command of that name."""
        return next((command for command in self.commands if command.name == name), None)


def read(text: bytes, where: str) -> Contract:
    """A contract from its JSON.

    Args:
        text: Of the file.
        where: What to call it in an error.

    Raises:
        Refused: It is not a contract, or it is a newer one.
    """
    try:
        found = json.loads(text)
        version = found["format"]
        if version > FORMAT:
            raise Refused(f"{where}: has format {version}, this node reads up to {FORMAT}; upgrade muster-policy")
        contract: Contract = _part(Contract, found)
    except KeyError as error:
        raise Refused(f"{where}: {error.args[0]} is missing; export the policy again") from None
    except (ValueError, TypeError, AttributeError) as error:
        raise Refused(f"{where}: it is not a policy contract ({error}); export the policy again") from None
    if not 0.0 < contract.control_hz <= 10_000.0:
        raise Refused(f"{where}: control_hz is {contract.control_hz:g}; export the policy again")
    for group in contract.groups:
        size = sum(term.size for term in group.terms)
        if group.terms and (size,) != group.shape:
            raise Refused(f"{where}: the terms of {group.name} have {size} numbers, its shape is {list(group.shape)}")
    return contract


def _part(kind: Any, found: Any) -> Any:
    """A part of the contract from its JSON, by the types of its fields; names that it does not know are left out.

    Raises KeyError, TypeError, ValueError, AttributeError.
    """
    parts = get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        types = get_type_hints(kind)
        names = [each.name for each in fields(kind) if each.name in found or each.default is MISSING]
        return kind(**{name: _part(types[name], found[name]) for name in names})
    if get_origin(kind) is UnionType:
        return None if found is None else _part(parts[0], found)
    if get_origin(kind) is tuple:
        kinds = [parts[0]] * len(found) if parts[-1] is ... else parts
        return tuple(_part(each, value) for each, value in zip(kinds, found, strict=True))
    if kind is np.ndarray:
        return np.asarray(found, dtype=np.float32)
    return kind(found) if kind in (int, float, bool) else found
