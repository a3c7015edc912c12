"""The geometry of a car's place on its track: the quantities from which tasks and reward functions are made.

Everything is a batch of points against all segments of the centre line, in the order in which a kernel would do it for one point:
look for the nearest segment, then take the rest from it. Of several nearest segments the first one counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from racer.tracks.arithmetic import Floats, cross, meetings, nearest, norm, segments_of
from racer.tracks.race_track import Track


@dataclass(frozen=True)
class Projection:
    """Points seen from the centre line; P points, in the direction in which each of them drives.

    Args:
        point: The nearest point of the centre line, (P, 2) [m].
        distance: How far it is, (P,) [m].
        left: Whether the point lies to the left of the centre line, (P,) bool; on it, it does not.
        before: The waypoint behind the nearest point, or at it, (P,) int64, counted from 0 at the start line in driving direction.
        after: The waypoint ahead of it, ``before`` + 1, (P,) int64: of a loop N is the start line again. Both are what reward functions
            know as ``closest_waypoints``.
        along: From the start line to the nearest point along the centre line, (P,) [m], from 0 to less than the track's length; at the
            end of an open track that length.
        progress: The same as a share of the track's length, (P,) [%].
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
    count, segments = len(track.center), len(track.steps)
    row, share = nearest(track.center, points, track.closed)
    # a segment has the waypoint at which its driver enters it, and not the one at which it leaves
    step_on = ~backwards & (share >= 1)
    step_back = backwards & (share <= 0)
    if not track.closed:  # but for the ends of the line
        step_on &= row < segments - 1
        step_back &= row > 0
    share = np.where(step_on, 0.0, np.where(step_back, 1.0, share))
    row = (row + step_on - step_back) % count
    following = (row + 1) % count

    start, segment = track.center[row], track.center[following] - track.center[row]
    point = start + share[:, None] * segment
    sign = np.where(backwards, -1.0, 1.0)
    forth = track.along[row] + share * track.steps[row]
    along = np.where(backwards, track.length - forth, forth)
    if track.closed:
        along = np.where(along >= track.length, 0.0, along)
    return Projection(
        point=point,
        distance=norm(points - point),
        left=sign * cross(segment, points - start) > 0,
        before=np.where(backwards, segments - 1 - row, row),
        after=np.where(backwards, segments - row, row + 1),
        along=along,
        progress=along / track.length * 100,
        heading=np.arctan2(sign * segment[:, 1], sign * segment[:, 0]),
        width=track.width[row] + share * (track.width[following] - track.width[row]),
    )


def on_road(track: Track, points: Any) -> NDArray[np.bool_]:
    """Which of ``points`` (P, 2) [m] lie between the borders, (P,) bool.

    A ray from a point on the road meets the two borders, and the ends of an open road, an odd number of times in all.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    borders = [segments_of(border, track.closed) for border in (track.inner, track.outer)]
    if not track.closed:
        borders.append((track.inner[[0, -1]], track.outer[[0, -1]]))
    start, end = (np.concatenate(each) for each in zip(*borders, strict=True))
    found: NDArray[np.bool_] = meetings(start, end, points) % 2 == 1
    return found


def place_at(track: Track, along: Any, backwards: Any = False) -> tuple[Floats, Floats]:
    """Points (S, 2) [m] of the centre line and its headings (S,) [rad] there, as :func:`project` has them.

    Args:
        track: The track.
        along: Distances from the start line in driving direction, (S,) [m]; they go round as often as they like, and end at the ends of an
            open track.
        backwards: Whether the waypoints are driven against their order: (S,) bool, or one for all.
    """
    along = np.atleast_1d(np.asarray(along, np.float64))
    if track.closed:
        along = np.mod(along, track.length)
        along = np.where(along >= track.length, 0.0, along)  # what is a hair behind the start line is rounded up to it
    else:
        along = np.clip(along, 0.0, track.length)
    backwards = np.broadcast_to(np.asarray(backwards, bool), len(along))
    forth = np.where(backwards, track.length - along, along)
    entered = np.where(backwards, *(np.searchsorted(track.along, forth, side=side) for side in ("left", "right")))
    row = entered - 1 if track.closed else np.clip(entered - 1, 0, len(track.steps) - 1)
    segment = track.center[(row + 1) % len(track.center)] - track.center[row]
    share = (forth - track.along[row]) / track.steps[row]
    sign = np.where(backwards, -1.0, 1.0)
    return track.center[row] + share[:, None] * segment, np.arctan2(sign * segment[:, 1], sign * segment[:, 0])


def advance(track: Track, before: Any, after: Any) -> Floats:
    """By how far a car has come on between two ``along`` (P,) [m], over the start line too; less than 0 where it went back.

    A car goes less than half of the track in one step.
    """
    moved: Floats = np.asarray(after, np.float64) - np.asarray(before, np.float64)
    if track.closed:
        half = track.length / 2
        moved = np.mod(moved + half, track.length) - half
    return moved
