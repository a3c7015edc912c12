"""The circuit: the scene that all worlds of a task share, with tracks side by side, and boxes on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from racer.tracks.arithmetic import Floats
from racer.tracks.geometry import place_at, project
from racer.tracks.obstacles import ObstacleConfig
from racer.tracks.race_track import Track
from shared_store.contract.error_text import counted
from worker.settings.overrides import Refused

GAP = 40.0
"""Between tracks [m]: a camera as low as the car's sees nothing of the next one."""
BOX = (0.4, 0.24, 0.2)
"""Length along the road, width, height of an obstacle [m]."""


@dataclass(frozen=True, eq=False)
class Circuit:
    """T tracks, each with K boxes.

    Attributes:
        tracks: One or more.
        corners: Where each track's own origin is in a world, (T, 2) [m].
        obstacle_poses: x, y [m] in the track's own frame and heading [rad], (T, K, 3).
        obstacle_along: From the start line in the order of the waypoints [m], (T, K).
    """

    tracks: Sequence[Track]
    corners: Floats
    obstacle_poses: Floats
    obstacle_along: Floats

    def __str__(self) -> str:
        boxes = self.obstacle_along.shape[1]
        return ", ".join(track.name for track in self.tracks) + (f", {counted(boxes, 'obstacle')}" if boxes else "")


def circuit_of(tracks: Sequence[Track], obstacles: Sequence[ObstacleConfig]) -> Circuit:
    """Tracks with the boxes that a configuration asks for, on each of them.

    A lane is the middle of the road's half at the inner or the outer border, or the centre line.

    Raises:
        Refused: A box is beyond the end of a track.
    """
    poses = np.zeros((len(tracks), len(obstacles), 3))
    for track_poses, track in zip(poses, tracks, strict=True):
        for number, obstacle in enumerate(obstacles):
            if obstacle.distance >= track.length:
                raise Refused(
                    ("obstacles", number, "distance"),
                    f"{obstacle.distance:g} m is beyond the end of track {track.name}, which is {track.length:.2f} m long",
                )
            track_poses[number] = _pose(track, obstacle)
    along = np.array([[obstacle.distance for obstacle in obstacles]] * len(tracks)).reshape(len(tracks), len(obstacles))
    return Circuit(tracks, side_by_side(tracks), poses, along)


def _pose(track: Track, obstacle: ObstacleConfig) -> Floats:
    points, headings = place_at(track, [obstacle.distance])
    found = project(track, points)
    point = points[0]
    if obstacle.lane != "center":
        row, following = int(found.before[0]), int(found.after[0]) % len(track.center)
        border = track.beside[0 if obstacle.lane == "inner" else 1]
        share = (obstacle.distance - track.along[row]) / track.steps[row]
        point = 0.5 * (point + border[row] + share * (border[following] - border[row]))
    return np.array([*point, headings[0]])


def side_by_side(tracks: Sequence[Track]) -> Floats:
    """Each track's origin in a world, (tracks, 2) [m]: in rows and columns, :data:`GAP` apart; that of one track alone is 0."""
    corners = np.zeros((len(tracks), 2))
    if len(tracks) == 1:
        return corners
    low, high = zip(*(bounds(track) for track in tracks), strict=True)
    cell = (np.array(high) - np.array(low)).max(axis=0) + GAP
    columns = math.ceil(math.sqrt(len(tracks)))
    for number in range(len(tracks)):
        corners[number] = cell * (number % columns, number // columns) - low[number]
    return corners


def bounds(track: Track) -> tuple[Floats, Floats]:
    """Least and greatest x and y of a track's borders [m]."""
    rings = np.concatenate((track.inner, track.outer))
    return rings.min(axis=0), rings.max(axis=0)
