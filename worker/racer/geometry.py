"""A car's place on its track: the quantities from which tasks and reward functions are made.

Everything is a batch of points against all segments of the centre line, in the order in which a kernel would do it for one point:
look for the nearest segment, then take the rest from it. Of several nearest segments the first one counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.racer.arithmetic import BLOCK, Floats, cross, meetings, norm
from worker.racer.track import Track


@dataclass(frozen=True)
class Projection:
    """Points seen from the centre line; P points, in the direction in which each of them drives.

    Args:
        point: The nearest point of the centre line, (P, 2) [m].
        distance: How far it is, (P,) [m].
        left: Whether the point lies to the left of the centre line, (P,) bool; on it, it does not.
        before: The waypoint behind the nearest point, or at it, (P,) int64, counted from 0 at the start line in driving direction.
        after: The waypoint ahead of it, ``before`` + 1, (P,) int64: N is the start line again. Both are what reward functions know as
            ``closest_waypoints``.
        along: From the start line to the nearest point along the centre line, (P,) [m], from 0 to less than the track's length.
        progress: The same as a share of the track's length, (P,) [%], from 0 to less than 100.
        heading: Of the centre line there, (P,) [rad], from -π to π; 0 is the x axis, counter-clockwise is positive.
        width: Of the road there, (P,) [m].
    """

    point: Floats
    distance: Floats
    left: NDArray[np.bool_]
    before: NDArray[np.int64]
    after: NDArray[np.int64]
    along: Floats
    progress: Floats
    heading: Floats
    width: Floats


def project(track: Track, points: Any, backwards: Any = False) -> Projection:
    """Project points onto the centre line.

    Args:
        track: The track.
        points: (P, 2) [m].
        backwards: Whether each point drives against the order of the waypoints: (P,) bool, or one for all.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    backwards = np.broadcast_to(np.asarray(backwards, bool), len(points))
    count = len(track.center)
    row, share = _nearest(track, points)
    # a segment has the waypoint at which its driver enters it, and not the one at which it leaves
    step_on = ~backwards & (share >= 1)
    step_back = backwards & (share <= 0)
    share = np.where(step_on, 0.0, np.where(step_back, 1.0, share))
    row = (row + step_on - step_back) % count
    following = (row + 1) % count

    start, segment = track.center[row], track.center[following] - track.center[row]
    point = start + share[:, None] * segment
    sign = np.where(backwards, -1.0, 1.0)
    forth = track.along[row] + share * track.steps[row]
    along = np.where(backwards, track.length - forth, forth)
    along = np.where(along >= track.length, 0.0, along)
    return Projection(
        point=point,
        distance=norm(points - point),
        left=sign * cross(segment, points - start) > 0,
        before=np.where(backwards, count - 1 - row, row),
        after=np.where(backwards, count - row, row + 1),
        along=along,
        progress=along / track.length * 100,
        heading=np.arctan2(sign * segment[:, 1], sign * segment[:, 0]),
        width=track.width[row] + share * (track.width[following] - track.width[row]),
    )


def on_road(track: Track, points: Any) -> NDArray[np.bool_]:
    """Which of ``points`` (P, 2) [m] lie between the borders, (P,) bool.

    A ray from a point on the road meets the two borders an odd number of times in all.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    start = np.concatenate((track.inner, track.outer))
    end = np.concatenate((np.roll(track.inner, -1, axis=0), np.roll(track.outer, -1, axis=0)))
    found: NDArray[np.bool_] = meetings(start, end, points) % 2 == 1
    return found


def place_at(track: Track, along: Any, backwards: Any = False) -> tuple[Floats, Floats]:
    """Points (S, 2) [m] of the centre line and its headings (S,) [rad] there, as :func:`project` has them.

    Args:
        track: The track.
        along: Distances from the start line in driving direction, (S,) [m]; they go round as often as they like.
        backwards: Whether the waypoints are driven against their order: (S,) bool, or one for all.
    """
    along = np.mod(np.atleast_1d(np.asarray(along, np.float64)), track.length)
    along = np.where(along >= track.length, 0.0, along)  # what is a hair behind the start line is rounded up to it
    backwards = np.broadcast_to(np.asarray(backwards, bool), len(along))
    forth = np.where(backwards, track.length - along, along)
    entered = np.where(backwards, *(np.searchsorted(track.along, forth, side=side) for side in ("left", "right")))
    row = entered - 1
    segment = track.center[(row + 1) % len(track.center)] - track.center[row]
    share = (forth - track.along[row]) / track.steps[row]
    sign = np.where(backwards, -1.0, 1.0)
    return track.center[row] + share[:, None] * segment, np.arctan2(sign * segment[:, 1], sign * segment[:, 0])


def advance(track: Track, before: Any, after: Any) -> Floats:
    """By how far a car has come on between two ``along`` (P,) [m], over the start line too; less than 0 where it went back.

    A car goes less than half of the track in one step.
    """
    half = track.length / 2
    moved: Floats = np.mod(np.asarray(after, np.float64) - np.asarray(before, np.float64) + half, track.length) - half
    return moved


def degrees(angles: Any) -> Floats:
    """Angles [rad] in degrees from -180 to 180, as reward functions see them."""
    return np.asarray(angles, np.float64) * (180 / math.pi)


def _nearest(track: Track, points: Floats) -> tuple[NDArray[np.int64], Floats]:
    """For each point the segment with the nearest point of the centre line, (P,) int64, and where on it that lies, (P,) from 0 to 1."""
    start, segment = track.center, np.roll(track.center, -1, axis=0) - track.center
    squared = track.steps * track.steps
    rows, shares = np.empty(len(points), np.int64), np.empty(len(points))
    size = max(1, BLOCK // len(start))
    for begin in range(0, len(points), size):
        here = slice(begin, begin + size)
        x = points[here, None, 0] - start[:, 0]
        y = points[here, None, 1] - start[:, 1]
        share = np.clip((x * segment[:, 0] + y * segment[:, 1]) / squared, 0.0, 1.0)
        x, y = x - share * segment[:, 0], y - share * segment[:, 1]
        row = (x * x + y * y).argmin(axis=1)
        rows[here] = row
        shares[here] = np.take_along_axis(share, row[:, None], 1)[:, 0]
    return rows, shares
