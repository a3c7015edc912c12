"""The policy's observations, built by the contract from a snapshot of the measurements: scale, clip, offsets, history, frames of a camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from muster_policy.contract import Command, Contract, Frame, Group, Term
from muster_policy.errors import Refused

IMU, ODOMETRY, JOINTS = "imu", "odom", "joint_states"
"""The inputs by their topics."""


@dataclass(frozen=True)
class Imu:
    """An inertial measurement unit, in its own frame.

    Attributes:
        turn: From its frame to the world's, shape ``(3, 3)``.
        angular: Angular velocity [rad/s], shape ``(3,)``.
        acceleration: Less gravity, so that it points up at rest [m/s^2], shape ``(3,)``.
    """

    turn: np.ndarray
    angular: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True)
class Odometry:
    """Pose of the root's frame in the world, and its velocities along its own axes.

    Attributes:
        position: [m], shape ``(3,)``.
        rotation: To the world's frame, a quaternion xyzw, shape ``(4,)``.
        linear: Of the origin [m/s], shape ``(3,)``.
        angular: [rad/s], shape ``(3,)``.
    """

    position: np.ndarray
    rotation: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


@dataclass
class Snapshot:
    """The current inputs.

    Attributes:
        position: Of the node's joints, in its order [m, rad], shape ``(joints,)``.
        velocity: Of the same joints [m/s, rad/s].
        imu: The unit; None if the policy needs none.
        odometry: None if the policy needs none.
        commands: Numbers by the command's name.
        images: The newest image of each group, shape ``(channels, height, width)``, uint8.
    """

    position: np.ndarray
    velocity: np.ndarray
    imu: Imu | None = None
    odometry: Odometry | None = None
    commands: Mapping[str, np.ndarray] = field(default_factory=dict)
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Place:
    """The place where a quantity is measured.

    Attributes:
        arm: Of the frame's origin, from the root's [m], shape ``(3,)``.
        turn: From the frame to the root's, shape ``(3, 3)``.
        unit: From the frame of the inertial measurement unit to the root's, shape ``(3, 3)``.
    """

    arm: np.ndarray
    turn: np.ndarray
    unit: np.ndarray


Quantity = Callable[[Snapshot, Place], "np.ndarray | float"]


def matrix(rotation: np.ndarray) -> np.ndarray:
    """The rotation matrix of a quaternion xyzw, shape ``(3, 3)``."""
    x, y, z, w = (float(each) for each in rotation)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The cross product of two vectors; many times faster than numpy's for so few numbers."""
    (a, b, c), (x, y, z) = first.tolist(), second.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


def place_of(frame: Frame | None, unit: Frame | None) -> Place:
    """The place where a quantity is measured.

    Args:
        frame: Of the quantity, on the root's body; None: the root's own.
        unit: Of the inertial measurement unit, on the root's body; None: the root's own.
    """
    arm = np.zeros(3) if frame is None else np.array(frame.position)
    turns = [np.eye(3) if each is None else matrix(np.array(each.rotation)) for each in (frame, unit)]
    return Place(arm, *turns)


def _imu(snapshot: Snapshot) -> Imu:
    assert snapshot.imu is not None
    return snapshot.imu


def _odometry(snapshot: Snapshot) -> Odometry:
    assert snapshot.odometry is not None
    return snapshot.odometry


def _velocity(snapshot: Snapshot, place: Place) -> np.ndarray:
    """Of the frame's origin, along its own axes."""
    odometry = _odometry(snapshot)
    found: np.ndarray = place.turn.T @ (odometry.linear + cross(odometry.angular, place.arm))
    return found


def _gravity(snapshot: Snapshot, place: Place) -> np.ndarray:
    """The direction of down in the root's frame: that of the unit, turned to the root's axes."""
    found: np.ndarray = place.unit @ -_imu(snapshot).turn[2]
    return found


def _in_world(snapshot: Snapshot, place: Place) -> np.ndarray:
    found: np.ndarray = matrix(_odometry(snapshot).rotation) @ _velocity(snapshot, place)
    return found


def _heading(snapshot: Snapshot, place: Place) -> float:
    forward = matrix(_odometry(snapshot).rotation)[:, 0]
    return float(np.arctan2(forward[1], forward[0]))


FROM_IMU: Mapping[str, Quantity] = {
    "imu_angular_velocity": lambda snapshot, place: _imu(snapshot).angular,
    "imu_acceleration": lambda snapshot, place: _imu(snapshot).acceleration,
    "imu_projected_gravity": lambda snapshot, place: -_imu(snapshot).turn[2],
    "root_angular_velocity": lambda snapshot, place: place.unit @ _imu(snapshot).angular,
    "projected_gravity": _gravity,
    "root_uprightness": lambda snapshot, place: -_gravity(snapshot, place)[2],
}
"""Quantities from a ``sensor_msgs/Imu``, by the name of the function in Muster's library."""
FROM_ODOMETRY: Mapping[str, Quantity] = {
    "imu_linear_velocity": _velocity,
    "root_linear_velocity": _velocity,
    "root_com_linear_velocity": _velocity,
    "root_linear_velocity_in_world": _in_world,
    "root_com_linear_velocity_in_world": _in_world,
    "root_position": lambda snapshot, place: _odometry(snapshot).position,
    "root_height": lambda snapshot, place: float(_odometry(snapshot).position[2]),
    "root_orientation": lambda snapshot, place: (
        (-1.0 if (turn := _odometry(snapshot).rotation)[3] < 0.0 else 1.0) * turn
    ),
    "heading": _heading,
}
"""Quantities from a ``nav_msgs/Odometry`` of the root's frame."""
OF_UNIT = frozenset({"imu_angular_velocity", "imu_acceleration", "imu_projected_gravity"})
"""Quantities in the unit's own frame; for these, the unit may be on any body."""


Reader = Callable[[Snapshot], "np.ndarray | float"]
VELOCITIES = frozenset({"velocity_command", "moving_velocity_command", "heading_velocity_command"})
"""Commands of Muster's library that are velocities forward, to the left [m/s] and turning left [rad/s]: a ``geometry_msgs/Twist``."""
_JOINT_POSITIONS = ("joint_position", "measured_joint_position")
_JOINT_OFFSETS = ("joint_offset", "measured_joint_offset")


class Observations:
    """Builds the policy's inputs, step by step.

    Args:
        contract: Of the policy.

    Raises:
        Refused: The node's inputs can't measure a term; one line names all such terms.

    Attributes:
        joints: The joints that it reads or drives, by name, in the order of a snapshot.
        needs: Inputs that it reads, by topic.
        commands: Commands that it reads.
        images: Groups that are images.
        quantities: Names of the quantities that it reads.
        unit: Frame of the inertial measurement unit; None: that of the root.
    """

    def __init__(self, contract: Contract) -> None:
        self._contract = contract
        self.joints = contract.joints
        self.needs: set[str] = {JOINTS}
        self.quantities: set[str] = set()
        self.commands: dict[str, Command] = {}
        self.images = {group.name: group for group in contract.groups if group.image is not None}
        self._problems: list[str] = []
        self.unit = self._find_unit()
        self._readers = {group.name: [self._reader(term) for term in group.terms] for group in contract.groups}
        for group in contract.groups:
            self._check_group(group)
        if self._problems:
            raise Refused(f"task {contract.task} can't run on a robot: " + "; ".join(self._problems))
        self._last = np.zeros(len(contract.action_names), np.float32)
        self._past: dict[str, np.ndarray] = {}

    def reset(self) -> None:
        """Begin an episode: no last action, no history."""
        self._last[:] = 0.0
        self._past.clear()

    def acted(self, action: np.ndarray) -> None:
        """Record the policy's action, shape ``(actions,)``."""
        self._last[:] = action

    def build(self, snapshot: Snapshot) -> dict[str, np.ndarray]:
        """The policy's inputs by name, each of shape ``(1, …)``, of the dtype that the policy takes."""
        found = {}
        for group in self._contract.groups:
            if group.image is not None:
                found[group.input] = self._stacked(group, snapshot)
            else:
                pairs = zip(group.terms, self._readers[group.name], strict=True)
                parts = [self._numbers(group.name, term, read(snapshot)) for term, read in pairs]
                found[group.input] = np.concatenate(parts)[None]
        return found

    def _numbers(self, group: str, term: Term, quantity: np.ndarray | float) -> np.ndarray:
        value: np.ndarray = np.atleast_1d(np.asarray(quantity, dtype=np.float32)) - term.offset
        if term.clip is not None:
            value = np.clip(value, *term.clip)
        value = value * term.scale
        if term.history == 1:
            return value
        key = f"{group}/{term.name}"
        past = self._past.get(key)
        past = np.tile(value, (term.history, 1)) if past is None else np.concatenate([past[1:], value[None]])
        self._past[key] = past
        return past.ravel()

    def _stacked(self, group: Group, snapshot: Snapshot) -> np.ndarray:
        assert group.image is not None
        image, past = snapshot.images[group.name], self._past.get(group.name)
        past = (
            np.tile(image, (group.image.frames, 1, 1)) if past is None else np.concatenate([image, past[: -len(image)]])
        )
        self._past[group.name] = past
        return past[None]

    def _find_unit(self) -> Frame | None:
        found: dict[tuple[str, str], Frame] = {}
        for term in (term for group in self._contract.groups for term in group.terms):
            if term.library and term.quantity in OF_UNIT and term.frame is not None:
                found[term.frame.body, term.frame.name] = term.frame
        if len(found) > 1:
            units = ", ".join(f"{name} on {body}" for body, name in found)
            self._problems.append(f"it has several inertial measurement units ({units}), the node reads one")
        return next(iter(found.values()), None)

    def _check_group(self, group: Group) -> None:
        image = group.image
        if image is None and not group.terms:
            self._problems.append(
                f"the contract does not say what the numbers of {group.name} are (a task of kernels by hand)"
            )
        if image is None or image.channels in (("red", "green", "blue"), ("grey",)):
            return
        self._problems.append(
            f"the images of {group.name} have the channels {', '.join(image.channels)}, the node reads red, green, blue or grey"
        )

    def _reader(self, term: Term) -> Reader:
        try:
            return self._measured(term)
        except Refused as problem:
            self._problems.append(f"{term.name}: {problem}")
            return lambda snapshot: 0.0

    def _measured(self, term: Term) -> Reader:
        """The reader of a term's quantity. Raises Refused with the missing input."""
        if not term.library:
            if self._contract.format < 2:
                raise Refused("the contract is of format 1, which does not say what it is; export the policy again")
            raise Refused(f"{term.quantity or 'a quantity that is not declared'} is not a function of Muster's library")
        if term.kind == "command":
            return self._command(term)
        if term.kind == "previous_action":
            return self._action(term)
        if term.element == "joint":
            return self._joint(term)
        if term.quantity in FROM_IMU:
            return self._placed(term, IMU)
        if term.quantity in FROM_ODOMETRY:
            return self._placed(term, ODOMETRY)
        sensors = ", ".join(term.sensors.values()) or "the simulation"
        raise Refused(f"{term.quantity} (of {sensors}) is in no message that the node reads")

    def _placed(self, term: Term, topic: str) -> Reader:
        frame, unit = term.frame, self.unit
        if frame is None:
            raise Refused(f"the contract does not say where {term.quantity} is measured; export the policy again")
        if term.quantity not in OF_UNIT:
            if not frame.root:
                raise Refused(
                    f"{term.quantity} is measured on {frame.body}, the node knows the motion of the root alone"
                )
            if topic == IMU and unit is not None and not unit.root:
                raise Refused(f"{term.quantity} is of the root, and the inertial measurement unit is on {unit.body}")
        self.needs.add(topic)
        self.quantities.add(term.quantity)
        place = place_of(frame, unit if unit is not None and unit.root else None)
        quantity = (FROM_IMU if topic == IMU else FROM_ODOMETRY)[term.quantity]
        return lambda snapshot: quantity(snapshot, place)

    def _joint(self, term: Term) -> Reader:
        columns = np.array([self.joints.index(name) for name in term.elements])
        if term.quantity in _JOINT_POSITIONS:
            return lambda snapshot: snapshot.position[columns]
        if term.quantity == "joint_velocity":
            return lambda snapshot: snapshot.velocity[columns]
        if term.quantity in _JOINT_OFFSETS:
            defaults = {action.name: action.default_position for action in self._contract.actions}
            if unknown := [name for name in term.elements if name not in defaults]:
                raise Refused(
                    f"the contract has no default position of {', '.join(unknown[:3])}, which no action drives"
                )
            start = np.array([defaults[name] for name in term.elements])
            return lambda snapshot: snapshot.position[columns] - start
        raise Refused(f"{term.quantity} of joints is in no message that the node reads")

    def _command(self, term: Term) -> Reader:
        command = self._contract.command(term.command)
        if command is None:
            raise Refused(f"the contract has no command {term.command}")
        whole = term.quantity == "command_number" and len(term.names) == len(command.names)
        if not whole and not (term.quantity == "command_vector" and len(command.names) >= 3):
            raise Refused(f"{term.quantity} of the command {command.name} is more than its numbers")
        self.commands[command.name] = command
        count, name = len(term.names), command.name
        return lambda snapshot: snapshot.commands[name][:count]

    def _action(self, term: Term) -> Reader:
        if self._contract.discrete:
            raise Refused("the node does not keep the numbers of choices")
        names = list(self._contract.action_names)
        columns = np.array([names.index(name) for name in term.elements])
        if term.quantity == "last_action":
            return lambda snapshot: self._last[columns]
        if term.quantity == "clipped_last_action":
            (limit,) = term.parameters.get("limit", (1.0,))
            return lambda snapshot: np.clip(self._last[columns], -limit, limit)
        raise Refused(f"{term.quantity} is none of the actions that the node keeps")


def is_twist(command: Any) -> bool:
    """Whether a command of the contract comes as a ``geometry_msgs/Twist``; else as a ``std_msgs/Float64MultiArray``."""
    return bool(command.library) and command.quantity in VELOCITIES


def command_topic(command: Command) -> str:
    """Topic of a command, in the node's namespace."""
    return "cmd_vel" if is_twist(command) else f"commands/{command.name}"


def image_topic(group: str) -> str:
    """Topic of an image, in the node's namespace."""
    return "image_raw" if group == "policy" else f"{group}/image_raw"
