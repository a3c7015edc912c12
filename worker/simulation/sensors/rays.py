"""Distances along rays from a frame on a robot, as of a laser scanner, to everything that cameras see."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import warp as wp

from worker.simulation.kinematics import yaw_quaternion
from worker.simulation.rendering import renderer
from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.height_scan import ALIGNMENTS, FEW_POINTS, GridPattern, RingPattern
from worker.simulation.sensors.sensor import Sensor, SensorContext, SensorDeclaration, place_pose
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})

_YAW = wp.constant(ALIGNMENTS.index("yaw"))
_WORLD = wp.constant(ALIGNMENTS.index("world"))


@wp.struct
class RayArrays:
    """Latest distances, measured after the last reset and before the last observation. One row per world.

    Attributes:
        distances: Distance from each ray's start to its hit, at most the declared ``max_distance`` [m], shape ``(worlds, rays)``.
        directions: Unit vectors of the rays, in their frame, shape ``(rays,)``.
    """

    distances: wp.array2d[wp.float32]
    directions: wp.array[wp.vec3]


@wp.kernel
def _follow(bodies: BodyArrays, body: int, mount: wp.transform, alignment: int, poses: wp.array[wp.transform]):
    """The frame of one world's rays."""
    world = wp.tid()
    pose = place_pose(bodies, world, body, mount)
    rotation = wp.transform_get_rotation(pose)
    if alignment == _WORLD:
        rotation = wp.quat_identity()
    if alignment == _YAW:
        rotation = yaw_quaternion(rotation)
    poses[world] = wp.transform(wp.transform_get_translation(pose), rotation)


@wp.kernel
def _measure(farthest: float, pixels: wp.array3d[wp.float32], arrays: RayArrays):
    """One ray of one world; Newton says 0 where nothing is hit."""
    world, ray = wp.tid()
    distance = pixels[world, 0, ray]
    if distance <= 0.0:
        distance = farthest
    arrays.distances[world, ray] = wp.min(distance, farthest)


@dataclass(frozen=True)
class LidarPattern:
    """Rays from one point: in each row, ``count`` rays spaced evenly around the frame's z axis.

    Attributes:
        count: Rays of a row, from right to left; each is in the middle of its part of ``angle``.
        elevations: Elevation of each row above the frame's x-y plane [rad].
        angle: Angle that a row covers, centred straight ahead [rad].
    """

    count: int = 32
    elevations: Sequence[float] = (0.0,)
    angle: float = 2 * math.pi

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins [m] and directions (unit vectors) in the frame, each of shape ``(rays, 3)``.

        Raises:
            ValueError: There is no ray, there are too many, or an angle is out of range.
        """
        if not isinstance(self.count, int) or not 1 <= self.count * len(self.elevations) <= FEW_POINTS:
            raise ValueError(
                f"LidarPattern has {self.count} rays in {len(self.elevations)} rows; use 1 to {FEW_POINTS:,} in all"
            )
        if not 0.0 < self.angle <= 2 * math.pi + 1e-6:
            raise ValueError(f"LidarPattern.angle is {self.angle}; use a number > 0, at most 2 pi [rad]")
        if not all(abs(each) <= math.pi / 2 for each in self.elevations):
            raise ValueError(
                f"LidarPattern.elevations is {list(self.elevations)}; use numbers from -pi/2 to pi/2 [rad]"
            )
        around = self.angle * ((np.arange(self.count) + 0.5) / self.count - 0.5)
        up = np.asarray(self.elevations, dtype=float)[:, None]
        parts = (np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up) + 0.0 * around)
        directions = np.stack(parts, axis=-1).reshape(-1, 3)
        return np.zeros_like(directions), directions


class RayCasting(Sensor):
    """:class:`RayCaster` of some worlds.

    It measures in :meth:`settle` alone, once a control step. Before that ``Worlds.update_bodies`` and ``Worlds.update_shapes`` must
    have been called.
    """

    state = ("distances",)

    def __init__(self, declared: RayCaster, context: SensorContext) -> None:
        super().__init__(context, declared.rows(context.views))
        (place,) = declared.places(context.views)
        mount = wp.transform(wp.vec3(*declared.position), wp.quat_identity())
        self._frame = (place.body, wp.transform_multiply(place.pose, mount), ALIGNMENTS.index(declared.alignment))
        self._farthest = declared.max_distance
        origins, directions = (each.astype(np.float32) for each in declared.rays())
        self.arrays = filled(RayArrays, self._device, (self._count, len(origins)), directions=directions)
        self._sensor = renderer(self._worlds.model, 1)
        # one row of pixels, each with a ray of its own
        self._rays = wp.array(
            np.stack((origins, directions), axis=1)[None, :, None], dtype=wp.vec3f, device=self._device
        )
        self._poses = context.array((self._count,), wp.transform)
        self._pixels = context.array((self._count, 1, len(origins)), wp.float32)

    def settle(self) -> None:
        """Cast the rays of every world."""
        self._launch(_follow, self._count, self._bodies, *self._frame, self._poses)
        self._sensor.update(self._worlds.state, self._poses, self._rays, depth_image=self._pixels)
        self._launch(_measure, self.arrays.distances.shape, self._farthest, self._pixels, self.arrays)


@dataclass(frozen=True)
class RayCaster(SensorDeclaration):
    """Distances along rays to everything that cameras see: the ground, terrain, objects and robots, including its own.

    Attributes:
        body: The body that carries the rays' frame. Give this or ``site``.
        site: The site that carries it.
        robot: The robot with that body or site.
        pattern: A :class:`LidarPattern`, or the points of a ``GridPattern`` or ``RingPattern``, whose rays all go down.
        position: Position of the rays' frame in the frame of the body or site [m].
        alignment: How the frame turns: ``base``, with the body or site; ``yaw``, with it about the vertical only; ``world``, not at all.
        start: Distance from the origin at which each ray starts, for example to clear the robot's own shapes [m].
        max_distance: Greatest reported distance [m].
    """

    body: str | None = None
    site: str | None = None
    robot: str = "robot"
    pattern: LidarPattern | GridPattern | RingPattern = LidarPattern()
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    alignment: Literal["yaw", "base", "world"] = "base"
    start: float = 0.0
    max_distance: float = 10.0
    arrays_type: ClassVar[Any] = RayArrays
    sensor_type: ClassVar[Any] = RayCasting

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each ray, of these robots and objects. Raises ValueError where a name matches nothing or a number is out of range."""
        if self.alignment not in ALIGNMENTS:
            raise ValueError(f"RayCaster.alignment is {self.alignment!r}; use one of {', '.join(ALIGNMENTS)}")
        for name, least in (("max_distance", 1e-9), ("start", 0.0)):
            if not least <= getattr(self, name) < math.inf:
                bound = "> 0" if least else ">= 0"
                raise ValueError(f"RayCaster.{name} is {getattr(self, name)}; use a number of metres {bound}")
        self.places(views)
        return [str(ray) for ray in range(len(self.rays()[0]))]

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins of the rays [m] and their directions (unit vectors) in their frame, each of shape ``(rays, 3)``.

        Raises:
            ValueError: A number of the pattern is out of range.
        """
        if isinstance(self.pattern, LidarPattern):
            origins, directions = self.pattern.rays()
        else:
            points = self.pattern.points()
            origins = np.concatenate((points, np.zeros((len(points), 1))), axis=-1)
            directions = np.tile((0.0, 0.0, -1.0), (len(points), 1))
        return origins + self.start * directions, directions
