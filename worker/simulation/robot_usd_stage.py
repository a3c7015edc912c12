"""The USD stage of a robot beside what Newton's importer built of it: prims, places, and values to compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import newton
import numpy as np
import warp as wp
from pxr import UsdGeom, UsdPhysics

from worker.simulation.robot_comparison import RobotDifference

RELATIVE = 1e-5
"""Two values are equal up to this share of the greatest one: USD keeps float32, and angles in degrees."""
PLACE = 1e-4
"""Two places are equal up to this distance [m] and angle [rad]."""


@dataclass
class UsdStage:
    """A USD file beside the builder that was made of it.

    Attributes:
        stage: ``Usd.Stage``.
        shown: The file's name, for errors.
        prims: All prims that were not left out.
        builder: Holds the robot alone, as imported; values are corrected in it.
        corrected: What was corrected.
        differences: What the builder can't hold.
        notes: What contacts and loops have otherwise, one sentence each.
    """

    stage: Any
    shown: str
    prims: list[Any]
    builder: newton.ModelBuilder
    corrected: list[RobotDifference] = field(default_factory=list)
    differences: list[RobotDifference] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @cached_property
    def bodies(self) -> dict[str, int]:
        """Index of each body of the builder, by its prim's path."""
        return {label: index for index, label in enumerate(self.builder.body_label)}

    @cached_property
    def joints(self) -> dict[str, int]:
        """Index of each joint of the builder, by its prim's path."""
        return {label: index for index, label in enumerate(self.builder.joint_label)}

    @cached_property
    def _turned(self) -> wp.transform:
        """From the stage's axes to those here, where z is up."""
        up = wp.vec3(*(float(UsdGeom.GetStageUpAxis(self.stage) == axis) for axis in "XYZ"))
        return wp.transform(wp.vec3(), wp.quat_between_vectors(up, wp.vec3(0.0, 0.0, 1.0)))

    @cached_property
    def _poses(self) -> Any:
        return UsdGeom.XformCache()

    def point(self, prim: Any, local: Any) -> Any:
        """A point in a prim's own coordinates, in the world [m]."""
        in_stage = self._poses.GetLocalToWorldTransform(prim).Transform(local)
        return wp.transform_point(self._turned, wp.vec3(*in_stage))

    def pose(self, prim: Any, position: Any = (0.0, 0.0, 0.0), rotation: Any = None) -> wp.transform:
        """A frame on a prim, in the world; scales move its origin only."""
        turned = self._poses.GetLocalToWorldTransform(prim).RemoveScaleShear().ExtractRotationQuat()
        local = quaternion(rotation) if rotation is not None else wp.quat_identity()
        return wp.transform(self.point(prim, position), wp.normalize(self._turned.q * quaternion(turned) * local))

    def owner(self, targets: Sequence[Any]) -> Any:
        """The body at the end of a joint: the target itself or the next one above; None: the world."""
        prim = self.stage.GetPrimAtPath(targets[0]) if targets else None
        while prim and not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            prim = prim.GetParent()
        return prim or None

    def correct(self, element: str, name: str, values: Any, index: int, file: Any, within: float = 0.0) -> None:
        """Let a value in one of the builder's lists be the file's, in Newton's units.

        Up to ``within`` they count as equal; 0: up to :data:`RELATIVE`.
        """
        built = values[index]
        if not same(built, file, within):
            self.corrected.append(RobotDifference(element, name, plain(built), plain(file)))
            values[index] = file

    def note(self, text: str) -> None:
        """Say once what contacts or loops have otherwise."""
        if text not in self.notes:
            self.notes.append(text)

    def differ(self, element: str, name: str, built: Any, file: Any) -> None:
        """Say that the builder can't hold a value."""
        self.differences.append(RobotDifference(element, name, plain(built), plain(file)))


def quaternion(value: Any) -> Any:
    """A quaternion of USD as one of Warp."""
    return wp.normalize(wp.quat(*map(float, value.GetImaginary()), float(value.GetReal())))


def plain(value: Any) -> Any:
    """A number, or an array of those of a vector, matrix or transform."""
    return np.array([*value], np.float64) if hasattr(value, "__len__") and not isinstance(value, str) else value


def same(built: Any, file: Any, within: float = 0.0) -> bool:
    """Whether two values are equal; of two infinite ones the sign counts, and Newton's greatest number is infinite."""
    in_muster, in_file = (np.ravel(plain(value)).astype(np.float64) for value in (built, file))
    in_muster = np.where(np.abs(in_muster) >= newton.MAXVAL, np.copysign(np.inf, in_muster), in_muster)
    finite = np.abs(in_file[np.isfinite(in_file)])
    return bool(np.allclose(in_muster, in_file, rtol=0.0, atol=within or 1e-7 + RELATIVE * finite.max(initial=0.0)))


def same_pose(built: wp.transform, file: wp.transform) -> bool:
    """Whether two frames are equal up to :data:`PLACE`."""
    between = wp.transform_inverse(file) * built
    return wp.length(between.p) <= PLACE and 2.0 * wp.length(wp.vec3(*[*between.q][:3])) <= PLACE


def authored(prim: Any, *names: str) -> Any:
    """The value of the first of some attributes that the file gives; None where it gives none."""
    for name in names:
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue() and attribute.Get() is not None:
            return attribute.Get()
    return None
