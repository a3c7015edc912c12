"""The road on the device: tracks, and where a point is on its track, as Warp functions for one point each (:mod:`racer.tracks.geometry`).

Several tracks lie one behind the other in the same arrays; every function has an argument for the track.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from racer.tracks.arithmetic import nearest_points, norm
from racer.tracks.geometry import project as project_all
from racer.tracks.race_track import Track

wp.set_module_options({"enable_backward": False})

REACH = 1.0
"""How far along the centre line the nearest segment is looked for, before and behind that of the step before [m]. In a control step of
1/15 s a car drives 0.27 m at most."""
FIRST_PLACE = wp.constant(0.15)
"""On an open track a car's middle is put at least so far behind the start line, so that all of its wheels are on the road [m]."""
LAST_PLACE = wp.constant(1.0)
"""An episode on an open track begins at least so far before its end [m]."""


@wp.struct
class RoadArrays:
    """All tracks of a task. The waypoints of track t are the rows from ``first[t]`` on, ``count[t]`` of them.

    Attributes:
        center: Waypoints in driving order [m], shape ``(waypoints,)``.
        inner: The border inside the loop beside each waypoint [m], shape ``(waypoints,)``.
        outer: The border outside [m], shape ``(waypoints,)``.
        along: From the start line to each waypoint [m], shape ``(waypoints,)``.
        steps: From each waypoint to the next [m], shape ``(waypoints,)``; the last one of an open track means nothing.
        width: Of the road at each waypoint [m], shape ``(waypoints,)``.
        first: First row of each track, shape ``(tracks,)``.
        count: Waypoints of each track, shape ``(tracks,)``.
        segments: Of each track's centre line, shape ``(tracks,)``: ``count``, or one less where it is open.
        length: Of each track's centre line [m], shape ``(tracks,)``.
        period: After which a distance along the track means the same place [m], shape ``(tracks,)``: the length of a loop. On an open
            track no distance comes back; it is twice the length there, more than any two places are apart.
        window: Segments that together are at least :data:`REACH` long, wherever on the track, shape ``(tracks,)``.
        clear: Whatever is closer to the centre line than this is on the road [m], shape ``(tracks,)``; 0 of an open one, for its ends.
        corner: Where the track's own origin is in a world [m], shape ``(tracks,)``: tracks lie side by side.
    """

    center: wp.array[wp.vec2]
    inner: wp.array[wp.vec2]
    outer: wp.array[wp.vec2]
    along: wp.array[wp.float32]
    steps: wp.array[wp.float32]
    width: wp.array[wp.float32]
    first: wp.array[wp.int32]
    count: wp.array[wp.int32]
    segments: wp.array[wp.int32]
    length: wp.array[wp.float32]
    period: wp.array[wp.float32]
    window: wp.array[wp.int32]
    clear: wp.array[wp.float32]
    corner: wp.array[wp.vec2]


@wp.struct
class Place:
    """A point seen from the centre line, as :class:`racer.tracks.geometry.Projection` of one point.

    Attributes:
        row: The nearest segment: that from waypoint ``row`` to the next one in the order of the waypoints.
        point: The nearest point of the centre line [m].
        distance: How far it is [m].
        left: Whether the point lies to the left of the centre line, in driving direction.
        before: The waypoint behind the nearest point, or at it, counted in driving direction.
        after: The waypoint ahead of it, ``before`` + 1.
        along: From the start line to the nearest point, in driving direction [m].
        heading: Of the centre line there, in driving direction [rad], from -pi to pi.
        width: Of the road there [m].
    """

    row: int
    point: wp.vec2
    distance: float
    left: bool
    before: int
    after: int
    along: float
    heading: float
    width: float


@wp.func
def cross(first: wp.vec2, second: wp.vec2) -> float:
    """Greater than 0 where ``second`` points left of ``first``."""
    return first[0] * second[1] - first[1] * second[0]


@wp.func
def is_open(road: RoadArrays, track: int) -> bool:
    """Whether the track is open, not a loop."""
    return road.segments[track] < road.count[track]


@wp.func
def next_row(road: RoadArrays, track: int, row: int) -> int:
    """The waypoint that follows, in the order of the waypoints."""
    return (row + 1) % road.count[track]


@wp.func
def nearest(road: RoadArrays, track: int, point: wp.vec2, begin: int, many: int):
    """Of ``many`` segments from ``begin`` on, the nearest one, and where on it the nearest point lies, from 0 to 1.

    Args:
        road: The tracks.
        track: Which of them.
        point: In the track's own frame [m].
        begin: A row, of any size: the rows of a loop go round.
        many: At most as many as the track has are looked at.
    """
    count = road.count[track]
    first = road.first[track]
    best, best_row, best_share = float(wp.inf), int(0), float(0.0)  # noqa: RUF046 (variables for Warp, not constants)
    if is_open(road, track):  # those of the range that exist, and at least one
        begin = wp.min(begin, road.segments[track] - 1)
        many = wp.clamp(begin + many, 1, road.segments[track]) - wp.max(begin, 0)
        begin = wp.max(begin, 0)
    for number in range(wp.min(many, count)):
        row = (begin + number) % count
        if row < 0:
            row += count
        start = road.center[first + row]
        segment = road.center[first + next_row(road, track, row)] - start
        step = road.steps[first + row]
        share = wp.clamp(wp.dot(point - start, segment) / (step * step), 0.0, 1.0)
        offset = point - start - share * segment
        squared = wp.dot(offset, offset)
        if squared < best:
            best = squared
            best_row = row
            best_share = share
    return best_row, best_share


@wp.func
def project(road: RoadArrays, track: int, point: wp.vec2, backwards: bool, begin: int, many: int) -> Place:
    """Project a point onto the centre line; of the arguments see :func:`nearest`.

    ``backwards`` says whether it drives against the order of the waypoints.
    """
    count = road.count[track]
    first = road.first[track]
    row, share = nearest(road, track, point, begin, many)
    at_start = is_open(road, track) and row == 0 and share <= 0.0
    at_end = is_open(road, track) and row == road.segments[track] - 1 and share >= 1.0
    # a segment has the waypoint at which its driver enters it, and not the one at which it leaves
    if not backwards and share >= 1.0 and not at_end:
        row = next_row(road, track, row)
        share = float(0.0)
    elif backwards and share <= 0.0 and not at_start:
        row = (row + count - 1) % count
        share = float(1.0)
    following = next_row(road, track, row)
    start = road.center[first + row]
    segment = road.center[first + following] - start
    place = Place()
    place.row = row
    place.point = start + share * segment
    place.distance = wp.length(point - place.point)
    forth = road.along[first + row] + share * road.steps[first + row]
    if at_end:
        forth = road.length[track]
    side = cross(segment, point - start)
    place.before = row
    place.along = forth
    ahead = segment
    if backwards:
        place.before = road.segments[track] - 1 - row
        place.along = road.length[track] - forth
        side = -side
        ahead = -segment
    place.after = place.before + 1
    if place.along >= road.length[track] and not is_open(road, track):
        place.along = 0.0
    place.left = side > 0.0
    place.heading = wp.atan2(ahead[1], ahead[0])
    place.width = road.width[first + row] + share * (road.width[first + following] - road.width[first + row])
    return place


@wp.func
def is_met(start: wp.vec2, end: wp.vec2, point: wp.vec2) -> bool:
    """Whether a ray from ``point`` to the right meets the segment."""
    if (start[1] > point[1]) == (end[1] > point[1]):
        return False
    return point[0] < start[0] + (point[1] - start[1]) * ((end[0] - start[0]) / (end[1] - start[1]))


@wp.func
def on_road(road: RoadArrays, track: int, point: wp.vec2) -> bool:
    """Whether a point lies between the borders: a ray from it meets the two, and an open road's ends, an odd number of times in all."""
    first = road.first[track]
    odd = bool(False)
    if is_open(road, track):
        last = first + road.segments[track]
        if is_met(road.inner[first], road.outer[first], point):
            odd = not odd
        if is_met(road.inner[last], road.outer[last], point):
            odd = not odd
    for row in range(road.segments[track]):
        following = next_row(road, track, row)
        if is_met(road.inner[first + row], road.inner[first + following], point):
            odd = not odd
        if is_met(road.outer[first + row], road.outer[first + following], point):
            odd = not odd
    return odd


@wp.func
def row_at(road: RoadArrays, track: int, forth: float) -> int:
    """The segment that has the point ``forth`` [m] from the start line, in the order of the waypoints; 0 <= forth <= length."""
    first = road.first[track]
    low = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    high = int(road.segments[track])
    while high - low > 1:
        middle = (low + high) / 2
        if road.along[first + middle] <= forth:
            low = middle
        else:
            high = middle
    return low


@wp.func
def around(value: float, length: float) -> float:
    """``value`` modulo ``length``, from 0 to less than that."""
    rest = value - wp.floor(value / length) * length
    if rest >= length or rest < 0.0:
        rest = 0.0
    return rest


@wp.func
def forth_of(road: RoadArrays, track: int, along: float, backwards: bool) -> float:
    """The distance [m] in the order of the waypoints of what is ``along`` [m] from the start line in driving direction.

    It goes round a loop, and ends at the ends of an open track.
    """
    length = road.length[track]
    forth = wp.clamp(along, 0.0, length)
    if backwards:
        forth = length - forth
    if not is_open(road, track):
        forth = around(along, length)
        if backwards:
            forth = around(length - forth, length)
    return forth


@wp.func
def place_at(road: RoadArrays, track: int, along: float, backwards: bool) -> wp.vec3:
    """The point of the centre line ``along`` [m] from the start line in driving direction, x and y [m], and its heading there [rad]."""
    first = road.first[track]
    forth = forth_of(road, track, along, backwards)
    row = row_at(road, track, forth)
    share = (forth - road.along[first + row]) / road.steps[first + row]
    if backwards and share <= 0.0 and (row > 0 or not is_open(road, track)):
        row = (row + road.count[track] - 1) % road.count[track]
        share = float(1.0)
    start = road.center[first + row]
    segment = road.center[first + next_row(road, track, row)] - start
    point = start + share * segment
    ahead = segment
    if backwards:
        ahead = -segment
    return wp.vec3(point[0], point[1], wp.atan2(ahead[1], ahead[0]))


@wp.func
def start_at(road: RoadArrays, track: int, share: float) -> float:
    """Where an episode begins that begins after ``share`` of the track, 0 to 1: distance from the start line in driving direction [m]."""
    along = share * road.length[track]
    if is_open(road, track):
        along = FIRST_PLACE + share * (road.length[track] - FIRST_PLACE - LAST_PLACE)
    return along


@wp.func
def width_at(road: RoadArrays, track: int, along: float, backwards: bool) -> float:
    """Width of the road ``along`` [m] from the start line in driving direction [m]."""
    first = road.first[track]
    forth = forth_of(road, track, along, backwards)
    row = row_at(road, track, forth)
    share = (forth - road.along[first + row]) / road.steps[first + row]
    here = road.width[first + row]
    return here + share * (road.width[first + next_row(road, track, row)] - here)


@wp.func
def advance(road: RoadArrays, track: int, before: float, after: float) -> float:
    """By how far a car has come on between two ``along`` [m], over the start line too; less than 0 where it went back."""
    half = road.period[track] / 2.0
    return around(after - before + half, road.period[track]) - half


def road_arrays(tracks: Sequence[Track], corners: np.ndarray, device: str) -> RoadArrays:
    """Tracks on a device.

    Args:
        tracks: One or more.
        corners: Where each track's own origin is in a world, (tracks, 2) [m].
        device: ``"cpu"`` or ``"cuda:<n>"``.
    """

    def floats(values: Any, dtype: Any = wp.float32) -> wp.array[Any]:
        return wp.array(np.asarray(values, np.float32), dtype=dtype, device=device)

    def joined(name: str, dtype: Any = wp.float32) -> wp.array[Any]:
        return floats(np.concatenate([getattr(track, name) for track in tracks]), dtype)

    counts = [len(track.center) for track in tracks]
    arrays = RoadArrays()
    for name in ("center", "inner", "outer"):
        setattr(arrays, name, joined(name, wp.vec2))
    for name in ("along", "width"):
        setattr(arrays, name, joined(name))
    arrays.steps = floats(np.concatenate([np.resize(track.steps, len(track.center)) for track in tracks]))
    arrays.first = wp.array(np.concatenate(([0], np.cumsum(counts)[:-1])), dtype=wp.int32, device=device)
    arrays.count = wp.array(counts, dtype=wp.int32, device=device)
    arrays.segments = wp.array([len(track.steps) for track in tracks], dtype=wp.int32, device=device)
    arrays.length = floats([track.length for track in tracks])
    arrays.period = floats([track.length if track.closed else 2 * track.length for track in tracks])
    arrays.window = wp.array([window_of(track) for track in tracks], dtype=wp.int32, device=device)
    arrays.clear = floats([clear_of(track) for track in tracks])
    arrays.corner = floats(corners, wp.vec2)
    return arrays


def window_of(track: Track) -> int:
    """Number of segments that together are at least :data:`REACH` long, wherever they begin; all of them on a shorter track."""
    count = len(track.steps)
    ends = np.concatenate(([0.0], np.cumsum(np.tile(track.steps, 2))))
    needed = np.searchsorted(ends, ends[:count] + REACH) - np.arange(count)
    return int(min(needed.max(), count))


def clear_of(track: Track) -> float:
    """The least distance between a border and the centre line, less a rounding error [m]; 0 of an open track.

    The nearest point of a border is at one of its waypoints, or where it passes one of the centre line.
    """
    if not track.closed:
        return 0.0
    borders = project_all(track, np.concatenate((track.inner, track.outer))).distance.min()
    passed = min(norm(nearest_points(ring, track.center) - track.center).min() for ring in (track.inner, track.outer))
    return float(min(borders, passed)) - 1e-4
