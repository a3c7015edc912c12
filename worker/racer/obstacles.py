"""Boxes that stand on the road, at distances along the track and in lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from worker.racer.arithmetic import Floats
from worker.racer.geometry import place_at, project
from worker.racer.track import Track
from worker.tasks.configs.racer import ObstacleConfig
from worker.tasks.overrides import Refused

SIZE = (0.4, 0.24, 0.2)
"""Length along the road, width, height of a box [m]."""


@dataclass(frozen=True)
class Obstacles:
    """The boxes of each of T tracks, K of them.

    Attributes:
        poses: x, y [m] in the track's own frame and heading [rad], (T, K, 3).
        along: From the start line in the order of the waypoints [m], (T, K).
    """

    poses: Floats
    along: Floats

    def fill(self, arrays: Any, device: str) -> None:
        """Write them into a :class:`worker.racer.car_arrays.CarArrays`."""
        shape = self.along.shape
        arrays.obstacle_half = wp.vec2(SIZE[0] / 2, SIZE[1] / 2)
        arrays.obstacle_poses = wp.zeros(shape, dtype=wp.vec3, device=device)
        arrays.obstacle_along = wp.zeros(shape, dtype=wp.float32, device=device)
        if shape[1]:
            arrays.obstacle_poses.assign(self.poses.astype(np.float32))
            arrays.obstacle_along.assign(self.along.astype(np.float32))


def place_obstacles(tracks: Sequence[Track], wanted: Sequence[ObstacleConfig]) -> Obstacles:
    """The boxes that a configuration asks for, on each track.

    A lane is the middle of the road's half at the inner or the outer border, or the centre line.

    Raises:
        Refused: A box is beyond the end of a track.
    """
    poses = np.zeros((len(tracks), len(wanted), 3))
    for track_poses, track in zip(poses, tracks, strict=True):
        for number, obstacle in enumerate(wanted):
            if obstacle.distance >= track.length:
                raise Refused(
                    ("obstacles", number, "distance"),
                    f"{obstacle.distance:g} m is beyond the end of track {track.name}, which is {track.length:.2f} m long",
                )
            track_poses[number] = _pose(track, obstacle)
    along = np.array([[obstacle.distance for obstacle in wanted]] * len(tracks)).reshape(len(tracks), len(wanted))
    return Obstacles(poses, along)


def _pose(track: Track, obstacle: ObstacleConfig) -> Floats:
    points, headings = place_at(track, [obstacle.distance])
    found = project(track, points)
    point = points[0]
    if obstacle.lane != "center":
        row, following = int(found.before[0]), int(found.after[0])
        ring = track.inner if obstacle.lane == "inner" else track.outer
        share = (obstacle.distance - track.along[row]) / track.steps[row]
        point = 0.5 * (point + ring[row] + share * (ring[following] - ring[row]))
    return np.array([*point, headings[0]])
