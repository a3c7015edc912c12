"""A height scan: heights of the ground around bodies or sites, on a pattern of points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import Sensor, SensorContext, SensorDeclaration, place_pose
from worker.simulation.structs import filled
from worker.simulation.terrain_arrays import TerrainArrays, flat_ground, ground_height

wp.set_module_options({"enable_backward": False})

ALIGNMENTS = ("yaw", "base", "world")
_BASE = wp.constant(ALIGNMENTS.index("base"))
_WORLD = wp.constant(ALIGNMENTS.index("world"))

FEW_POINTS = 100_000
"""Most points of a pattern; more suggest a mistaken resolution."""


@wp.struct
class HeightScanArrays:
    """The ground under the points of a scan, one row per world; all points of the first frame come first.

    Attributes:
        heights: Of the sensor's frame above the ground at each point [m], shape ``(worlds, points)``.
        points: Of the ground, in the world's frame [m], shape ``(worlds, points)``.
    """

    heights: wp.array2d[wp.float32]
    points: wp.array2d[wp.vec3]


@wp.struct
class _Scan:
    bodies: wp.array[wp.int32]
    locals: wp.array[wp.transform]
    pattern: wp.array[wp.vec2]
    alignment: int
    farthest: float


@wp.func
def turned_by_yaw(rotation: wp.quat, point: wp.vec3) -> wp.vec3:
    """A point turned about the vertical as a rotation turns the x axis, seen from above; a rotation that points x straight up turns nothing."""
    forward = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))
    length = wp.sqrt(forward[0] * forward[0] + forward[1] * forward[1])
    cosine = float(1.0)
    sine = float(0.0)
    if length > 1.0e-6:
        cosine = forward[0] / length
        sine = forward[1] / length
    return wp.vec3(cosine * point[0] - sine * point[1], sine * point[0] + cosine * point[1], point[2])


@wp.kernel
def _scan(
    fresh_only: bool,
    episodes: EpisodeArrays,
    bodies: BodyArrays,
    terrain: TerrainArrays,
    scan: _Scan,
    arrays: HeightScanArrays,
):
    """One point of one world."""
    world, point = wp.tid()
    if fresh_only and episodes.ages[world] != 0:
        return
    count = scan.pattern.shape[0]
    frame = point // count
    pose = place_pose(bodies, world, scan.bodies[frame], scan.locals[frame])
    origin = wp.transform_get_translation(pose)
    rotation = wp.transform_get_rotation(pose)
    place = scan.pattern[point - frame * count]
    offset = wp.vec3(place[0], place[1], 0.0)
    if scan.alignment == _BASE:
        offset = wp.quat_rotate(rotation, offset)
    elif scan.alignment != _WORLD:
        offset = turned_by_yaw(rotation, offset)
    above = origin + offset
    ground = ground_height(terrain, above[0], above[1])
    arrays.heights[world, point] = wp.min(above[2] - ground, scan.farthest)
    arrays.points[world, point] = wp.vec3(above[0], above[1], ground)


@dataclass(frozen=True)
class GridPattern:
    """Points of a rectangle around the frame, row by row from behind on the right; in a row x grows.

    Attributes:
        size: Lengths of the rectangle along x (ahead) and y (to the left) [m].
        resolution: Distance between neighbouring points [m].
    """

    size: tuple[float, float] = (1.6, 1.0)
    resolution: float = 0.1

    def points(self) -> np.ndarray:
        """Places x and y relative to the frame [m], shape ``(points, 2)``.

        Raises:
            ValueError: A length is negative, the resolution is not positive, or there are too many points.
        """
        if not self.resolution > 0:
            raise ValueError(f"GridPattern.resolution is {self.resolution}; use a number of metres > 0")
        if not min(self.size) >= 0:
            raise ValueError(f"GridPattern.size is {self.size}; use two lengths >= 0")
        # from minus half a length on, as many steps as fit: the pattern of Isaac Lab and mjlab
        counts = [math.floor(length / self.resolution + 1e-6) + 1 for length in self.size]
        if math.prod(counts) > FEW_POINTS:
            raise ValueError(
                f"GridPattern has {math.prod(counts):,} points; use a resolution coarser than {self.resolution:g} m, or a smaller size"
            )
        x, y = (
            -length / 2 + self.resolution * np.arange(count) for length, count in zip(self.size, counts, strict=True)
        )
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class RingPattern:
    """Points of a circle around the frame, the first ahead, then to the left.

    Attributes:
        radius: Radius of the circle [m].
        count: Number of points on it.
        center: Whether the frame's own position is added as the first point.
    """

    radius: float
    count: int = 4
    center: bool = False

    def points(self) -> np.ndarray:
        """Places x and y relative to the frame [m], shape ``(points, 2)``.

        Raises:
            ValueError: The radius is negative, or there is no point.
        """
        if not self.radius >= 0 or not 1 <= self.count <= FEW_POINTS:
            raise ValueError(
                f"RingPattern has {self.count} points at {self.radius} m; use 1 to {FEW_POINTS:,} and a radius >= 0"
            )
        angles = 2 * np.pi * np.arange(self.count) / self.count
        ring = self.radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        return np.concatenate((np.zeros((1, 2)), ring)) if self.center else ring


class HeightScanSensor(Sensor):
    """:class:`HeightScan` of some worlds. It names each point: body or site, and its position in the pattern [m]."""

    needs_bodies = True
    state = ("heights", "points")

    def __init__(self, declared: HeightScan, context: SensorContext) -> None:
        declared.rows(context.views)
        pattern, places = declared.pattern.points(), declared.places(context.views)
        super().__init__(context, [f"{place.name} {x:+.2f} {y:+.2f}" for place in places for x, y in pattern])
        ground = self._worlds.ground
        self._terrain = ground.arrays if ground else flat_ground(self._device)
        offset = wp.transform(declared.offset, wp.quat_identity())
        self._scan = filled(
            _Scan,
            self._device,
            bodies=[place.body for place in places],
            locals=[wp.transform_multiply(place.pose, offset) for place in places],
            pattern=pattern.astype(np.float32),
            alignment=ALIGNMENTS.index(declared.alignment),
            farthest=declared.max_distance,
        )
        self.arrays = filled(HeightScanArrays, self._device, (self._count, len(self.names)))

    def advance(self) -> None:
        """Measure all worlds."""
        self._measure(fresh_only=False)

    def settle(self) -> None:
        """Measure again in worlds that were just reset."""
        self._measure(fresh_only=True)

    def _measure(self, fresh_only: bool) -> None:
        inputs = (fresh_only, self._episodes, self._bodies, self._terrain, self._scan, self.arrays)
        self._launch(_scan, (self._count, len(self.names)), *inputs)


@dataclass(frozen=True)
class HeightScan(SensorDeclaration):
    """Heights of frames on a robot above the ground around them.

    Heights are looked up in the terrain, exactly on the triangles that shapes collide with. Vertical rays that see only the ground would
    give the same, at many times the cost. Without a terrain the ground is the plane z = 0.

    Attributes:
        bodies: Pattern or patterns of the bodies, each a frame. Give this or ``sites``.
        sites: Pattern or patterns of the sites, each a frame.
        robot: The robot with these bodies or sites.
        pattern: Points around each frame.
        alignment: How the pattern turns: ``yaw``, with the frame about the vertical only; ``base``, with the frame in all axes, so that
            each height is measured straight down from the tilted pattern; ``world``, not at all.
        offset: Position of the sensor's frame in the frame of the body or site [m].
        max_distance: Greatest reported height [m].
    """

    bodies: str | Sequence[str] | None = None
    sites: str | Sequence[str] | None = None
    robot: str = "robot"
    pattern: GridPattern | RingPattern = GridPattern()
    alignment: Literal["yaw", "base", "world"] = "yaw"
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    max_distance: float = 5.0
    arrays_type: ClassVar[Any] = HeightScanArrays
    sensor_type: ClassVar[Any] = HeightScanSensor

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Number of each point. Raises ValueError where a pattern or a name matches nothing, or a number is out of range."""
        if self.alignment not in ALIGNMENTS:
            raise ValueError(f"HeightScan.alignment is {self.alignment!r}; use one of {', '.join(ALIGNMENTS)}")
        if not self.max_distance > 0:
            raise ValueError(f"HeightScan.max_distance is {self.max_distance}; use a number of metres > 0")
        return [str(point) for point in range(len(self.places(views)) * len(self.pattern.points()))]
