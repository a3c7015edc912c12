"""Poses and velocities of bodies and sites, in the world's frame or in that of another body or site."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import (
    BodyFrame,
    Sensor,
    SensorContext,
    SensorDeclaration,
    find_place,
    place_pose,
    place_velocity,
)
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})


@wp.struct
class FrameArrays:
    """Poses and velocities of bodies or sites, one row per world, one column per body or site.

    Attributes:
        positions: Of the origins [m], shape ``(worlds, columns)``.
        rotations: From the body's or site's axes [quaternion xyzw], shape ``(worlds, columns)``.
        linear: Velocities of the origins [m/s], shape ``(worlds, columns)``.
        angular: Angular velocities [rad/s], shape ``(worlds, columns)``.
    """

    positions: wp.array2d[wp.vec3]
    rotations: wp.array2d[wp.quat]
    linear: wp.array2d[wp.vec3]
    angular: wp.array2d[wp.vec3]


@wp.kernel
def _measure(
    bodies: BodyArrays,
    columns: wp.array[wp.int32],
    locals: wp.array[wp.transform],
    reference: int,
    reference_local: wp.transform,
    frames: FrameArrays,
):
    """One frame in one world. In a moving frame of reference velocities are as one who moves and turns with it sees them."""
    world, column = wp.tid()
    pose = place_pose(bodies, world, columns[column], locals[column])
    position = wp.transform_get_translation(pose)
    linear, angular = place_velocity(bodies, world, columns[column], position)

    seen_from = place_pose(bodies, world, reference, reference_local)
    origin = wp.transform_get_translation(seen_from)
    turned = wp.transform_get_rotation(seen_from)
    origin_linear, origin_angular = place_velocity(bodies, world, reference, origin)
    offset = position - origin
    frames.positions[world, column] = wp.quat_rotate_inv(turned, offset)
    frames.rotations[world, column] = wp.quat_inverse(turned) * wp.transform_get_rotation(pose)
    relative = linear - origin_linear - wp.cross(origin_angular, offset)
    frames.linear[world, column] = wp.quat_rotate_inv(turned, relative)
    frames.angular[world, column] = wp.quat_rotate_inv(turned, angular - origin_angular)


class FrameSensor(Sensor):
    """:class:`Frames` of some worlds."""

    needs_bodies = True
    state = ("positions", "rotations", "linear", "angular")

    def __init__(self, declared: Frames, context: SensorContext) -> None:
        places, self._reference = declared.places(context.views), declared.reference(context.views)
        super().__init__(context, [place.name for place in places])
        self._columns = wp.array([place.body for place in places], dtype=wp.int32, device=self._device)
        self._locals = wp.array([place.pose for place in places], dtype=wp.transform, device=self._device)
        self.arrays = filled(FrameArrays, self._device, (self._count, len(places)))

    def advance(self) -> None:
        """Measure the present poses and velocities."""
        reference = self._reference.body, self._reference.pose
        inputs = (self._bodies, self._columns, self._locals, *reference, self.arrays)
        self._launch(_measure, (self._count, len(self.names)), *inputs)

    def settle(self) -> None:
        """Measure again, since resets moved some worlds."""
        self.advance()


@dataclass(frozen=True)
class Frames(SensorDeclaration):
    """Poses and velocities of bodies or sites.

    They are those of MuJoCo's ``framepos``, ``framequat``, ``framelinvel`` and ``frameangvel``, with and without a reference.

    Attributes:
        bodies: Pattern or patterns of the bodies, each a column. Give this or ``sites``.
        sites: Pattern or patterns of the sites, each a column.
        robot: The robot with these bodies or sites.
        relative_to: Body whose moving frame is the frame of reference; None: the world, unless ``relative_to_site`` is given.
        relative_to_site: Site whose moving frame is the frame of reference.
        reference_robot: The robot with that body or site; None: ``robot``.
    """

    bodies: str | Sequence[str] | None = None
    sites: str | Sequence[str] | None = None
    robot: str = "robot"
    relative_to: str | None = None
    relative_to_site: str | None = None
    reference_robot: str | None = None
    arrays_type: ClassVar[Any] = FrameArrays
    sensor_type: ClassVar[Any] = FrameSensor

    def reference(self, views: Mapping[str, RobotView]) -> BodyFrame:
        """The frame of reference. Raises ValueError where it is not one body or site."""
        if self.relative_to is None and self.relative_to_site is None:
            if self.reference_robot is not None:
                raise ValueError(
                    "Frames.reference_robot: name its body as relative_to, or its site as relative_to_site"
                )
            return BodyFrame("world", -1, wp.transform_identity())
        if self.relative_to is not None and self.relative_to_site is not None:
            raise ValueError("Frames: give either relative_to, a body, or relative_to_site, and not both")
        owner = self.robot if self.reference_robot is None else self.reference_robot
        return find_place(views, "Frames.relative_to", owner, self.relative_to, self.relative_to_site)
