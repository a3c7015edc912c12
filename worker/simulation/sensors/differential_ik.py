"""Differential IK (inverse kinematics): position targets of joints that move a frame of a robot as actions ask. It measures nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import newton
import numpy as np
import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.ik_kernels import Chain, IkArrays, begin_targets, move_frame
from worker.simulation.sensors.sensor import BodyFrame, Sensor, SensorContext, SensorDeclaration
from worker.simulation.structs import filled, views_of

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Directions in which a frame may be moved: along the axes of the root or of the world [m], and about them [rad]."""
QUATERNION = ("qx", "qy", "qz", "qw")
"""The columns of an absolute orientation."""
FRAMES = ("root", "world")
"""Frames whose axes can be used."""


class IkSolver(Sensor):
    """:class:`DifferentialIK` of some worlds. It acts before the physics."""

    needs_bodies = True

    def __init__(self, declared: DifferentialIK, context: SensorContext) -> None:
        super().__init__(context, declared.rows(context.views))
        (place,) = declared.places(context.views)
        self._robot, count = context.robots[declared.robot], self._count
        view, joints = context.views[declared.robot], declared.driven(context.views)
        self.arrays = filled(IkArrays, self._device, (count, len(self.names)))
        rows = [AXES.index(axis) for axis in declared.axes if axis in AXES]
        columns = [column for column, axis in enumerate(declared.axes) if axis in AXES]
        turn = -1
        if QUATERNION[0] in declared.axes:
            turn = [*declared.axes].index(QUATERNION[0])
            rows, columns = [*rows, 3, 4, 5], [*columns, 0, 0, 0]
        self._chain = filled(
            Chain,
            self._device,
            body=place.body,
            pose=place.pose,
            in_world=declared.frame == "world",
            absolute=declared.absolute,
            turn=turn,
            rows=rows,
            columns=columns,
            weights=[(declared.position_weight if row < 3 else declared.orientation_weight) ** 2 for row in rows],
            joints=joints,
            ranges=_ranges(view, joints, declared.soft_factor),
            damping=declared.damping**2,
            posture=declared.posture_weight**2,
            limits=declared.limit_weight**2,
            max_step=declared.max_step,
            errors=context.array((len(rows), count), wp.float32),
            jacobian=context.array((len(rows), len(joints), count), wp.float32),
            matrix=context.array((len(joints), len(joints), count), wp.float32),
            steps=context.array((len(joints), count), wp.float32),
            goes_on=declared.from_targets,
            targets=context.array((count, len(joints)), wp.float32),
            **self._joints(view, joints),
        )

    def _joints(self, view: RobotView, joints: list[int]) -> dict[str, Any]:
        """Bodies, anchors and axes of the joints, which are the same in every world."""
        model, dofs = self._worlds.model, [view.dofs[joint] for joint in joints]
        owners = np.searchsorted(model.joint_qd_start.numpy(), dofs, side="right") - 1
        mounts, axes = model.joint_X_c.numpy()[owners], model.joint_axis.numpy()[dofs]
        return {
            "children": [view.joint_bodies[joint] for joint in joints],
            "slides": [view.joint_types[joint] == newton.JointType.PRISMATIC for joint in joints],
            "anchors": mounts[:, :3],
            "axes": [
                wp.quat_rotate(wp.quat(*mount[3:]), wp.vec3(*axis)) for mount, axis in zip(mounts, axes, strict=True)
            ],
        }

    def act(self) -> None:
        """Write the joints' targets after all actions are written. Call ``Worlds.update_bodies`` first."""
        self._launch(move_frame, self._count, self._worlds.arrays, self._bodies, self._robot, self._chain, self.arrays)

    def settle(self) -> None:
        """Forget the last targets where an episode begins."""
        if self._chain.goes_on:
            self._launch(begin_targets, self._count, self._worlds.arrays, self._episodes, self._robot, self._chain)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """The last targets, if the next ones are relative to them."""
        return views_of(self._chain, "targets") if self._chain.goes_on else {}


def _ranges(view: RobotView, joints: list[int], share: float) -> np.ndarray:
    """Ranges of joints of which a share counts, about their middle [m, rad], shape ``(joints, 2)``, float32."""
    ranges = np.array([view.ranges[joint] for joint in joints])
    limited = np.isfinite(ranges).all(axis=1)
    margins = 0.5 * (1.0 - share) * (ranges[limited, 1] - ranges[limited, 0])
    ranges[limited] += np.stack((margins, -margins), axis=1)
    return ranges.astype(np.float32)


@dataclass(frozen=True)
class DifferentialIK(SensorDeclaration):
    """Joints that move a frame of a robot. ``terms.move_frame`` gives a displacement or a pose, and damped least squares computes
    position targets.

    The targets are q + dq, or the last targets + dq, with dq of (J^T W J + damping^2 1) dq = J^T W dx; dx is the displacement, or the
    remaining distance to an absolute target. The targets hold for a control step; the joints' actuators must be position servos. J and q
    are those at the step's start: mjlab and Isaac Lab solve again in every physics step. Encoder bias is ignored: displacements start at
    the joint's true position.

    Attributes:
        body: The body that is moved, by its frame's origin. Give this or ``site``.
        site: The site that is moved.
        joints: Pattern or patterns of the joints that move it. Each turns or slides about one axis, lies between root and frame and has
            an actuator; it belongs to one declaration.
        robot: The robot with this frame and these joints.
        axes: The columns, from :data:`AXES`: along and about the axes of ``frame``. Directions not named here are left free. Turns about
            several axes are one rotation vector. Where it is ``absolute``: some of x, y, z, and for an orientation qx, qy, qz, qw.
        absolute: Whether an action is the frame's position [m] and orientation (quaternion xyzw, which need not have the length 1; of
            length 0: as it is), not a displacement. Then all columns belong to one action.
        frame: ``"root"``: axes, positions and orientations are those in the frame of the robot's root; ``"world"``: in the world's.
        position_weight: Weight of errors along x, y and z [1/m].
        orientation_weight: Weight of errors about them [1/rad].
        damping: Weight of the joints' displacements [1/rad, 1/m]: it shortens steps, above all near singular poses such as a stretched arm.
        max_step: Greatest distance of a joint's target from the joint's position [rad, m].
        posture_weight: Draws joints to their default positions [1/rad, 1/m]; 0: not at all.
        limit_weight: Draws joints back from beyond their limits [1/rad, 1/m], so that the other joints compensate; 0: not at all.
        soft_factor: Fraction of each joint's range, about its middle, that bounds targets and the limits of ``limit_weight``.
        from_targets: Whether dq is added to the last targets, not to the joints' positions: an arm then holds its own weight, and servos
            catch up with small steps. The targets of a new episode start at the joints' positions.
    """

    body: str | None = None
    site: str | None = None
    joints: str | Sequence[str] = "*"
    robot: str = "robot"
    axes: Sequence[str] = ("x", "y", "z")
    absolute: bool = False
    frame: str = "root"
    position_weight: float = 1.0
    orientation_weight: float = 1.0
    damping: float = 0.05
    max_step: float = 0.5
    posture_weight: float = 0.0
    limit_weight: float = 0.0
    soft_factor: float = 1.0
    from_targets: bool = False
    arrays_type: ClassVar[Any] = IkArrays
    sensor_type: ClassVar[Any] = IkSolver

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each column, such as ``hand_x``.

        Raises:
            ValueError: A name matches nothing, a number is out of range, or a joint can't move the frame about or along one axis.
        """
        (place,) = self.places(views)
        self._check_axes()
        self._check_numbers()
        self._check_joints(views[self.robot], place)
        return [f"{place.name}_{axis}" for axis in self.axes]

    def _check_axes(self) -> None:
        known = AXES[:3] + QUATERNION if self.absolute else AXES
        if isinstance(self.axes, str) or not self.axes or len({*self.axes}) != len(self.axes):
            raise ValueError(f"DifferentialIK.axes is {self.axes!r}; give some of {', '.join(known)}, each once")
        for axis in self.axes:
            if axis not in known:
                raise ValueError(f"DifferentialIK.axes: there is no axis {axis!r}; {nearest(str(axis), known)}")
        turns = [axis for axis in self.axes if axis in QUATERNION]
        if turns and " ".join(QUATERNION) not in " ".join(self.axes):
            raise ValueError(
                f"DifferentialIK.axes has {', '.join(turns)}; an orientation is {', '.join(QUATERNION)}, in this order"
            )
        if self.frame not in FRAMES:
            raise ValueError(f"DifferentialIK.frame is {self.frame!r}; {nearest(str(self.frame), FRAMES)}")
        if self.absolute and self.from_targets:
            raise ValueError("DifferentialIK.from_targets adds up movements; leave it out where absolute=True")

    def _check_numbers(self) -> None:
        for name in ("position_weight", "orientation_weight", "damping", "max_step", "soft_factor"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"DifferentialIK.{name} is {value}; use a finite number > 0")
        for name in ("posture_weight", "limit_weight"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"DifferentialIK.{name} is {value}; use a finite number >= 0")
        if self.soft_factor > 1.0:
            raise ValueError(f"DifferentialIK.soft_factor is {self.soft_factor}; use a number > 0, at most 1")

    def _check_joints(self, view: RobotView, place: BodyFrame) -> None:
        between = view.joints_moving(place.body)
        for joint in view.find_joints(self.joints):
            if joint not in between:
                those = ", ".join(view.joint_names[each] for each in between) or "none"
                raise ValueError(
                    f"DifferentialIK.joints: {view.joint_names[joint]} does not move {place.name}; those that do: {those}"
                )
            if view.joint_types[joint] not in (newton.JointType.REVOLUTE, newton.JointType.PRISMATIC):
                raise ValueError(
                    f"DifferentialIK.joints: {view.joint_names[joint]} is one of several joints between the same two bodies; "
                    "put a body between them in the robot's file, or leave it out"
                )

    def driven(self, views: Mapping[str, RobotView]) -> list[int]:
        """Indices of the joints in ``RobotView.joint_names``. Raises ValueError where a pattern matches nothing."""
        return views[self.robot].find_joints(self.joints)

    def description(self, views: Mapping[str, RobotView]) -> str:
        """Describes the use of the columns in words, with every number."""
        view = views[self.robot]
        joints = ", ".join(view.joint_names[joint] for joint in self.driven(views))
        names = ("position_weight", "orientation_weight", "damping", "max_step", "posture_weight", "limit_weight")
        numbers = ", ".join(f"{name} = {getattr(self, name):g}" for name in (*names, "soft_factor"))
        moved = f"the body {self.body}" if self.site is None else f"the site {self.site}"
        verb, how = ("bring", "to") if self.absolute else ("move", "by")
        return (
            f"damped least squares make position targets of {joints} that {verb} {moved} in the {self.frame}'s frame {how} "
            f"{', '.join(self.axes)} ({numbers})"
            f"{', each from the last targets' if self.from_targets else ''}"
        )
