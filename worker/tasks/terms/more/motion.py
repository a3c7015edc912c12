"""A recorded motion for a robot to follow: its file, and its arrays on the device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
import warp as wp

from worker.simulation.sensors.sensor import place_names
from worker.tasks.terms.more.frame_sampling import AdaptiveSampling, FrameSampling, SamplingArrays

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView
    from worker.simulation.sensors.sensor import SensorContext

wp.set_module_options({"enable_backward": False})

_WIDTHS = {
    "joint_pos": 0,
    "joint_vel": 0,
    "body_pos_w": 3,
    "body_quat_w": 4,
    "body_lin_vel_w": 3,
    "body_ang_vel_w": 3,
}
"""Arrays of the file, and the last dimension of arrays with one row per body."""


@wp.struct
class MotionArrays:
    """A recorded motion, one row per frame, one column per joint of the robot or per tracked body.

    Attributes:
        joint_positions: Positions of all joints of the robot [m, rad], shape ``(frames, joints)``.
        joint_velocities: Their velocities [m/s, rad/s], same shape.
        positions: Positions of the bodies' origins, in the world frame [m], shape ``(frames, bodies)``.
        rotations: Rotations of the bodies [quaternion xyzw], shape ``(frames, bodies)``.
        linear: Velocities of the bodies' origins, in the world frame [m/s], shape ``(frames, bodies)``.
        angular: Angular velocities, in the world frame [rad/s], shape ``(frames, bodies)``.
        roots: Pose of the root, shape ``(frames,)``.
        root_linear: Velocity of the root's origin, in the world frame [m/s], shape ``(frames,)``.
        root_angular: Angular velocity of the root, in the world frame [rad/s], shape ``(frames,)``.
        bodies: Columns of the tracked bodies in ``BodyArrays``, shape ``(bodies,)``.
        anchor: Index among these of the anchor, the frame of reference of the others.
        rate: Frames per control step.
        sampling: Sampling of the start frames of episodes.
    """

    joint_positions: wp.array2d[wp.float32]
    joint_velocities: wp.array2d[wp.float32]
    positions: wp.array2d[wp.vec3]
    rotations: wp.array2d[wp.quat]
    linear: wp.array2d[wp.vec3]
    angular: wp.array2d[wp.vec3]
    roots: wp.array[wp.transform]
    root_linear: wp.array[wp.vec3]
    root_angular: wp.array[wp.vec3]
    bodies: wp.array[wp.int32]
    anchor: int
    rate: float
    sampling: SamplingArrays


@dataclass(frozen=True)
class Motion:
    """A recorded motion, declared among a task's sensors for terms with a parameter ``motion``.

    Attributes:
        file: NumPy archive as mjlab writes it: ``fps``, ``joint_pos`` and ``joint_vel`` (frames, joints), ``body_pos_w``,
            ``body_quat_w`` (wxyz), ``body_lin_vel_w`` (of the bodies' origins) and ``body_ang_vel_w`` (frames, bodies, ...), in the world
            frame, of all joints and bodies of the robot in the model's order, the root first.
        bodies: Pattern or patterns of the tracked bodies.
        anchor: The frame of reference of the others, one of ``bodies``.
        robot: The robot that follows it.
        sampling: Sampling of the start frames of episodes; None: all are equally likely.
    """

    arrays_type: ClassVar[Any] = MotionArrays
    file: str | Path
    bodies: str | Sequence[str]
    anchor: str
    robot: str = "robot"
    sampling: AdaptiveSampling | None = None

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each tracked body. Raises ValueError if a pattern or a name matches nothing."""
        return place_names(views, "Motion", self.robot, bodies=self.bodies)

    def build(self, context: SensorContext) -> RecordedMotion:
        """The motion on the device of these worlds.

        Raises:
            ValueError: The file can't be read, lacks an array, or is of another robot; a pattern fits no body, or a number of the
                sampling is out of its range.
        """
        view = context.view(self.robot, "Motion.robot")
        found = view.find_bodies(self.bodies)
        names = [view.body_names[each] for each in found]
        anchors = view.find_bodies(self.anchor)
        if len(anchors) != 1 or anchors[0] not in found:
            raise ValueError(
                f"Motion.anchor: name one of the bodies that are followed, not {self.anchor!r}; {', '.join(names)}"
            )
        data = _read(Path(self.file), len(view.joint_names), len(view.body_names))
        arrays = MotionArrays()
        device = context.device
        data["body_quat_w"] = data["body_quat_w"][..., [1, 2, 3, 0]]
        for name, key in (("joint_positions", "joint_pos"), ("joint_velocities", "joint_vel")):
            setattr(arrays, name, wp.array(data[key], dtype=wp.float32, device=device))
        kinds = (
            ("positions", "pos", wp.vec3),
            ("rotations", "quat", wp.quat),
            ("linear", "lin_vel", wp.vec3),
            ("angular", "ang_vel", wp.vec3),
        )
        for name, key, kind in kinds:
            setattr(arrays, name, wp.array(data[f"body_{key}_w"][:, found], dtype=kind, device=device))
        roots = np.concatenate([data["body_pos_w"][:, 0], data["body_quat_w"][:, 0]], axis=-1)
        arrays.roots = wp.array(roots, dtype=wp.transform, device=device)
        arrays.root_linear = wp.array(data["body_lin_vel_w"][:, 0], dtype=wp.vec3, device=device)
        arrays.root_angular = wp.array(data["body_ang_vel_w"][:, 0], dtype=wp.vec3, device=device)
        arrays.bodies = wp.array([view.bodies[each] for each in found], dtype=wp.int32, device=device)
        arrays.anchor = found.index(anchors[0])
        arrays.rate = float(data["fps"]) / context.control_hz
        length = len(data["joint_pos"]) / float(data["fps"])
        sampling = FrameSampling(self.sampling, length, context.worlds.world_count, device)
        arrays.sampling = sampling.arrays
        return RecordedMotion(arrays, tuple(names), sampling)


class RecordedMotion:
    """A :class:`Motion` of some worlds. The motion never changes; the sampling of start frames may.

    Args:
        arrays: The motion.
        names: Names of the tracked bodies.
        sampling: Sampling of the start frames of episodes.
    """

    needs_bodies = False

    def __init__(self, arrays: MotionArrays, names: tuple[str, ...], sampling: FrameSampling) -> None:
        self.arrays, self.names, self.sampling = arrays, names, sampling

    def advance(self) -> None:
        """Count the failures. The command of a world is its present frame."""
        self.sampling.advance()

    def settle(self) -> None:
        """No-op: a reset changes nothing."""

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """State of the sampling."""
        return self.sampling.state_tensors()


def _read(file: Path, joints: int, bodies: int) -> dict[str, np.ndarray]:
    """The arrays of a motion's file, float32, with the robot's shapes."""
    try:
        with np.load(file) as archive:
            data = {
                name: np.asarray(archive[name], dtype=np.float32) for name in archive.files if name in (*_WIDTHS, "fps")
            }
    except (OSError, ValueError, AttributeError) as error:
        raise ValueError(f"Motion.file: {file} can't be read as a NumPy archive: {error}") from error
    if lacking := [name for name in ("fps", *_WIDTHS) if name not in data]:
        raise ValueError(
            f"Motion.file: {file} has no array {lacking[0]}; it has {', '.join(data) or 'none of a motion'}"
        )
    frames = data["joint_pos"].shape[0]
    for name, width in _WIDTHS.items():
        expected = (frames, bodies, width) if width else (frames, joints)
        if data[name].shape != expected or frames == 0:
            raise ValueError(
                f"Motion.file: {name} of {file} has the shape {data[name].shape}; the robot has {joints} joints and {bodies} bodies, so "
                f"it must be {expected}, with one frame or more"
            )
        if not np.isfinite(data[name]).all():
            raise ValueError(f"Motion.file: {name} of {file} has numbers that are not finite")
    data["fps"] = data["fps"].reshape(-1)[:1]
    if data["fps"].size != 1 or not data["fps"][0] > 0:
        raise ValueError(f"Motion.file: fps of {file} must be one number above 0")
    data["fps"] = data["fps"][0]
    return data
