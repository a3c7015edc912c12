"""A snapshot of the measurements of one moment, and the quantities derived from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from muster_policy.contract import Frame

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
