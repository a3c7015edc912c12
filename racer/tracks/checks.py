"""Checks of a track before a car may drive on it; each refusal is one line: the fault, its row and its place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from racer.tracks.arithmetic import Floats, cross, meetings, nearest_points, norm, segments_of
from worker.settings.errors import UserError

WAYPOINTS = (20, 5000)
"""Greatest number; the car looks at all of them in every step."""
LENGTHS = (4.0, 1000.0)
"""Of the centre line [m]."""
WIDTHS = (0.3, 5.0)
"""Of the road, at each waypoint [m]; a car of 1:18 is 0.2 m wide."""
LONGEST_STEP = 2.0
"""Between two waypoints [m]."""
SHORTEST_STEP = 1e-3
"""Between two waypoints [m]; what is shorter is a point that stands there twice."""
FARTHEST = 1e4
"""Of a coordinate [m]."""
LEAST_RADIUS = 0.25
"""Of the centre line's curves [m]; with its wheels turned by 30° a car turns with a radius of 0.28 m."""
CURVE = 0.3
"""Over this distance ahead and behind a curve is measured [m]: digitised tracks are not smooth from point to point."""
LEVEL = 0.005
"""By this share the borders may be nearer to a waypoint than their own rows: a file has corners where the road has curves."""
RINGS = ("centre line", "inner border", "outer border")

_BLOCK = 512
"""Segments that are compared with all others at once."""
_MOST_REPORTED = 1000
"""Crossings of each block among which the one to report is looked for."""


class BadTrack(UserError):
    """This can't be a track; the message is one line that says what is wrong, where, and what to do."""


def check(center: Floats, inner: Floats, outer: Floats, closed: bool = True) -> None:
    """Raise BadTrack for lines that aren't a track.

    Args:
        center: Waypoints of the centre line (N, 2) [m] in driving order, the first one not repeated.
        inner: The inner border, (N, 2) [m].
        outer: The outer border, (N, 2) [m].
        closed: Whether the last waypoint leads to the first.
    """
    rings = (center, inner, outer)
    if len(center) < WAYPOINTS[0]:
        raise BadTrack(f"{len(center)} different waypoints are too few: a track has {WAYPOINTS[0]} or more")
    if len(center) > WAYPOINTS[1]:
        raise BadTrack(f"{len(center)} waypoints are too many: a track has at most {WAYPOINTS[1]}; space them wider")
    for ring, name in zip(rings, RINGS, strict=True):
        check_numbers(ring, name)
    _check_steps(center, closed)
    _check_curves(center, closed)
    if crossing := first_crossing(rings, closed):
        raise BadTrack(_describe_crossing(rings, *crossing))
    if closed:
        if not inside(center, inner[:1])[0]:
            turned = " (the borders seem to be swapped)" if inside(center, outer[:1])[0] else ""
            raise BadTrack(f"the inner border lies outside the centre line: {at(inner, 0)}{turned}")
        if not inside(outer, center[:1])[0]:
            raise BadTrack(f"the outer border does not enclose the centre line: {at(outer, 0)}")
    elif not (left_of_line(center, inner).all() and not left_of_line(center, outer).any()):
        raise BadTrack(
            "an open track has its inner border on the left of the centre line, and its outer one on the right"
        )
    _check_width(*beside(center, inner, outer, closed))


def check_numbers(ring: Floats, name: str) -> None:
    """Raise BadTrack where a coordinate is not finite, or so large that it can't be metres."""
    wrong = np.flatnonzero(~(np.abs(ring) <= FARTHEST).all(axis=1))
    if len(wrong):
        what = "not finite" if not np.isfinite(ring[wrong[0]]).all() else f"farther than {FARTHEST:g} m from the origin"
        raise BadTrack(f"{name}: {at(ring, int(wrong[0]))} is {what}; coordinates are metres")


def at(ring: Floats, row: int) -> str:
    """A row and its place, for messages."""
    return f"row {row} (x {ring[row, 0]:.3f}, y {ring[row, 1]:.3f})"


def steps_of(line: Floats, closed: bool = True) -> Floats:
    """Lengths of the segments from each point of a line (N, 2) to the next, (N,) [m]; (N - 1,) of an open one."""
    start, end = segments_of(line, closed)
    return norm(end - start)


def radii_of(center: Floats, closed: bool = True) -> Floats:
    """Radius (N,) of the curve at each waypoint [m]; infinite on a straight.

    It is that of the circle through the waypoint and the two that lie about :data:`CURVE` before and behind it; at the ends of an open
    line, where one of them is missing, there is no curve.
    """
    spacing = float(np.cumsum(steps_of(center, closed))[-1]) / len(center)
    reach = max(1, round(CURVE / spacing))
    behind, ahead = center - np.roll(center, reach, axis=0), np.roll(center, -reach, axis=0) - center
    twice_area = np.abs(cross(behind, ahead))
    product = norm(behind) * norm(ahead) * norm(behind + ahead)
    with np.errstate(divide="ignore", invalid="ignore"):
        radii = product / (2 * twice_area)
    # three points on a line: they go on along it, or they turn back on it
    backwards = behind[:, 0] * ahead[:, 0] + behind[:, 1] * ahead[:, 1] < 0
    found: Floats = np.where(twice_area == 0, np.where(backwards, 0.0, np.inf), radii)
    if not closed:
        found[:reach] = found[-reach:] = np.inf
    return found


def beside(center: Floats, inner: Floats, outer: Floats, closed: bool = True) -> tuple[Floats, Floats]:
    """The points of both borders across the road from each waypoint, two of (N, 2) [m].

    In many files the border rows are not level with those of the centre line. These points are the nearest ones of the borders, from
    which AWS's simulator takes ``track_width``; a row that is level (to :data:`LEVEL`) stays as it is.
    """
    points = [nearest_points(border, center, closed) for border in (inner, outer)]
    rows = norm(inner - center) + norm(outer - center)
    level = rows <= (1 + LEVEL) * sum(norm(each - center) for each in points)
    found = (np.where(level[:, None], border, each) for border, each in zip((inner, outer), points, strict=True))
    return next(found), next(found)


def area_of(ring: Floats) -> float:
    """Signed area of a ring (N, 2) [m²]: greater than 0 where its points go round counter-clockwise."""
    return float(cross(ring, np.roll(ring, -1, axis=0)).sum() / 2)


def inside(ring: Floats, points: Floats) -> NDArray[np.bool_]:
    """Which of ``points`` (P, 2) lie inside a ring (N, 2), as (P,)."""
    found: NDArray[np.bool_] = meetings(ring, np.roll(ring, -1, axis=0), points) % 2 == 1
    return found


def left_of_line(center: Floats, border: Floats) -> NDArray[np.bool_]:
    """Whether the points of a border (N, 2) that are nearest to each waypoint of an open line lie to the left of it, (N,)."""
    offset = nearest_points(border, center, closed=False) - center
    ahead = np.diff(center, axis=0)
    left: NDArray[np.bool_] = cross(np.concatenate((ahead, ahead[-1:])), offset) > 0
    return left


def first_crossing(rings: tuple[Floats, ...], closed: bool = True) -> tuple[int, int, int, int] | None:
    """The first place where rings touch or cross: ring, row, other ring, other row; None without one.

    A ring that crosses itself comes first. A row stands for the segment from it to the next. Neighbours in a ring meet where they
    should; points of a border that stand there several times (a hairpin turns about one point) count once.
    """
    kept = [np.flatnonzero(steps_of(ring) > SHORTEST_STEP) for ring in rings]
    ends = [segments_of(ring[rows], closed) for ring, rows in zip(rings, kept, strict=True)]
    kept = [rows[: len(each[0])] for rows, each in zip(kept, ends, strict=True)]
    start, end = (np.concatenate(each) for each in zip(*ends, strict=True))
    which = np.repeat(np.arange(len(rings)), [len(rows) for rows in kept])
    place = np.concatenate([np.arange(len(rows)) for rows in kept])
    size = np.array([len(rows) for rows in kept])[which]
    low, high = np.minimum(start, end), np.maximum(start, end)
    found: list[tuple[bool, int, int, int, int]] = []
    for begin in range(0, len(start), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        near = (low[rows, None, 0] <= high[:, 0]) & (low[:, 0] <= high[rows, None, 0])
        near &= (low[rows, None, 1] <= high[:, 1]) & (low[:, 1] <= high[rows, None, 1])
        i, j = np.nonzero(near)
        i += begin
        apart = np.abs(place[i] - place[j])
        neighbours = (apart <= 1) | (closed & (apart >= size[i] - 1))
        other = (i < j) & ((which[i] != which[j]) | ~neighbours)
        i, j = i[other], j[other]
        meet = _straddles(start[i], end[i], start[j], end[j]) & _straddles(start[j], end[j], start[i], end[i])
        for k, m in zip(i[meet][:_MOST_REPORTED], j[meet][:_MOST_REPORTED], strict=True):
            a, b = int(which[k]), int(which[m])
            found.append((a != b, a, int(kept[a][place[k]]), b, int(kept[b][place[m]])))
    return min(found)[1:] if found else None


def _straddles(start: Floats, end: Floats, first: Floats, second: Floats) -> NDArray[np.bool_]:
    """Whether ``first`` and ``second`` lie on different sides of the line through ``start`` and ``end``, or on it."""
    along = end - start
    found: NDArray[np.bool_] = np.sign(cross(along, first - start)) * np.sign(cross(along, second - start)) <= 0
    return found


def _describe_crossing(rings: tuple[Floats, ...], ring: int, row: int, other: int, other_row: int) -> str:
    where = f"{at(rings[ring], row)}"
    if ring == other:
        return f"the {RINGS[ring]} crosses or touches itself: {where} and {at(rings[other], other_row)}"
    return f"the {RINGS[ring]} and the {RINGS[other]} cross or touch: {where} and {at(rings[other], other_row)}"


def _check_steps(center: Floats, closed: bool) -> None:
    steps = steps_of(center, closed)
    if steps.max() > LONGEST_STEP:
        row = int(steps.argmax())
        raise BadTrack(
            f"the centre line has a gap of {steps[row]:.2f} m after {at(center, row)}: waypoints are at most {LONGEST_STEP:g} m apart"
        )
    if steps.min() < SHORTEST_STEP:
        raise BadTrack(
            f"the waypoint of {at(center, int(steps.argmin()))} stands there twice; an import leaves such rows out"
        )
    if not LENGTHS[0] <= steps.sum() <= LENGTHS[1]:
        raise BadTrack(f"a length of {steps.sum():.2f} m: a track is {LENGTHS[0]:g} to {LENGTHS[1]:g} m long")


def _check_width(inner: Floats, outer: Floats) -> None:
    widths = norm(outer - inner)
    for row in (int(widths.argmin()), int(widths.argmax())):
        if not WIDTHS[0] <= widths[row] <= WIDTHS[1]:
            raise BadTrack(
                f"the road is {widths[row]:.3f} m wide at row {row} (inner border x {inner[row, 0]:.3f}, y {inner[row, 1]:.3f}): "
                f"expected {WIDTHS[0]:g} to {WIDTHS[1]:g} m"
            )


def _check_curves(center: Floats, closed: bool) -> None:
    radii = radii_of(center, closed)
    row = int(radii.argmin())
    if radii[row] < LEAST_RADIUS:
        raise BadTrack(
            f"the curve at {at(center, row)} has a radius of {radii[row]:.2f} m, which no car can drive: {LEAST_RADIUS:g} m is the least"
        )
