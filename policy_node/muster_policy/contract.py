"""The node's view of a bundle's ``contract.json``: the policy's inputs and outputs, term by term."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
    position: np.ndarray
    rotation: np.ndarray
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
    library: bool
    parameters: Mapping[str, Sequence[float]]
    element: str
    elements: tuple[str, ...]
    sensors: Mapping[str, str]
    command: str
    frame: Frame | None

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
    range: Pair | None
    rule: str
    targets: tuple[Target, ...] = ()
    """Of a choice."""


@dataclass(frozen=True)
class Command:
    """The operator's command."""

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    ranges: tuple[Pair | None, ...]
    quantity: str
    library: bool


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

    def command(self, name: str) -> Command | None:
        """The command of that name."""
        return next((command for command in self.commands if command.name == name), None)


def read(text: bytes, where: str) -> Contract:
    """A contract from its JSON.

    Args:
        text: Of the file.
        where: What to call it in an error.

    Raises:
        Refused: It is no contract, or a newer one.
    """
    try:
        found = json.loads(text)
        version = found["format"]
        if version > FORMAT:
            raise Refused(f"{where}: has format {version}, this node reads up to {FORMAT}; upgrade muster-policy")
        contract = Contract(
            task=found["task"],
            format=version,
            control_hz=float(found["control_hz"]),
            groups=tuple(map(_group, found["groups"])),
            actions=tuple(map(_action, found["actions"])),
            action_names=tuple(found["action_names"]),
            commands=tuple(map(_command, found["commands"])),
            states=tuple(State(each["name"], each["output"], tuple(each["shape"])) for each in found["states"]),
            discrete=bool(found["discrete"]),
        )
    except KeyError as error:
        raise Refused(f"{where}: {error.args[0]} is missing; export the policy again") from None
    except (ValueError, TypeError, AttributeError) as error:
        raise Refused(f"{where}: it is no policy contract ({error}); export the policy again") from None
    if not 0.0 < contract.control_hz <= 10_000.0:
        raise Refused(f"{where}: control_hz is {contract.control_hz:g}; export the policy again")
    for group in contract.groups:
        there = sum(term.size for term in group.terms)
        if group.terms and (there,) != group.shape:
            raise Refused(f"{where}: the terms of {group.name} have {there} numbers, its shape is {list(group.shape)}")
    return contract


def _numbers(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def _pair(value: Any) -> Pair | None:
    return None if value is None else (float(value[0]), float(value[1]))


def _group(found: Mapping[str, Any]) -> Group:
    image = found["image"]
    return Group(
        name=found["name"],
        input=found["input"],
        shape=tuple(found["shape"]),
        dtype=found["dtype"],
        terms=tuple(map(_term, found["terms"])),
        image=None if image is None else Image(tuple(image["channels"]), int(image["frames"])),
    )


def _term(found: Mapping[str, Any]) -> Term:
    frame = found.get("frame")
    return Term(
        name=found["name"],
        kind=found["kind"],
        names=tuple(found["names"]),
        scale=_numbers(found["scale"]),
        offset=_numbers(found["offset"]),
        clip=_pair(found["clip"]),
        history=int(found["history"]),
        quantity=found["quantity"],
        library=bool(found.get("library", False)),
        parameters=found["parameters"],
        element=found["element"],
        elements=tuple(found["elements"]),
        sensors=found["sensors"],
        command=found["command"],
        frame=None
        if frame is None
        else Frame(
            frame["name"],
            frame["body"],
            np.asarray(frame["position"], float),
            np.asarray(frame["rotation"], float),
            bool(frame["root"]),
        ),
    )


def _action(found: Mapping[str, Any]) -> Action:
    limit = found["effort_limit"]
    return Action(
        name=found["name"],
        kind=found["kind"],
        unit=found["unit"],
        scale=float(found["scale"]),
        offset=float(found["offset"]),
        clip=_pair(found["clip"]),
        default_position=float(found["default_position"]),
        stiffness=float(found["stiffness"]),
        damping=float(found["damping"]),
        effort_limit=None if limit is None else float(limit),
        range=_pair(found.get("range")),
        rule=found["rule"],
        targets=tuple(
            Target(each["joint"], each["kind"], each["unit"], float(each["value"])) for each in found.get("targets", ())
        ),
    )


def _command(found: Mapping[str, Any]) -> Command:
    return Command(
        name=found["name"],
        names=tuple(found["names"]),
        units=tuple(found["units"]),
        ranges=tuple(map(_pair, found["ranges"])),
        quantity=found.get("quantity", ""),
        library=bool(found.get("library", False)),
    )
