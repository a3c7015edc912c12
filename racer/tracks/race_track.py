"""A race track: a road with a centre line and two borders, a loop as a rule.

In memory the lines are N different points. The segment from the last one to the first closes those of a loop; in files the first row
stands at the end once more (N + 1 rows), as the community's tools expect. An open track leads from its first point to its last.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np

from racer.tracks.arithmetic import Floats, norm
from racer.tracks.checks import FARTHEST, area_of, beside, check, radii_of, steps_of

Direction = Literal["counter-clockwise", "clockwise"]
COUNTER_CLOCKWISE: Direction = "counter-clockwise"
CLOCKWISE: Direction = "clockwise"
OPEN: Final = "open"
DIRECTIONS: tuple[Direction, ...] = (COUNTER_CLOCKWISE, CLOCKWISE)


@dataclass(frozen=True, eq=False)
class Track:
    """A track that was checked (:mod:`racer.tracks.checks`); its arrays can't be written.

    Args:
        name: What people call it.
        center: Waypoints of the centre line in driving order, (N, 2) float64 [m]; the start line is at row 0.
        inner: The border inside the loop, (N, 2) float64 [m]: on the left of a track that goes round counter-clockwise, on the right of a
            clockwise one. Its rows need not be level with the waypoints: :attr:`beside`.
        outer: The border outside, (N, 2) float64 [m].
        closed: Whether it is a loop. Of an open track the inner border is the left one, as in AWS's simulator.

    Raises:
        BadTrack: It is none.
    """

    name: str
    center: Floats
    inner: Floats
    outer: Floats
    closed: bool = True

    def __post_init__(self) -> None:
        for field in ("center", "inner", "outer"):
            ring = np.array(getattr(self, field), np.float64, order="C")
            ring.flags.writeable = False
            object.__setattr__(self, field, ring)
        check(self.center, self.inner, self.outer, self.closed)

    @cached_property
    def beside(self) -> tuple[Floats, Floats]:
        """The points of the inner and the outer border across the road from each waypoint, two of (N, 2) [m]."""
        return beside(self.center, self.inner, self.outer, self.closed)

    @cached_property
    def slanted(self) -> int:
        """How many rows of the borders are not level with their waypoint."""
        inner, outer = self.beside
        return int(((inner != self.inner) | (outer != self.outer)).any(axis=1).sum())

    @property
    def slant(self) -> str:
        """What is to say of :attr:`slanted` rows, one line."""
        rows = f"{self.slanted} of {len(self.center)} rows of its borders"
        return f"{rows} are not level with their waypoint: widths are taken across the road"

    @cached_property
    def width(self) -> Floats:
        """Of the road at each waypoint, (N,) [m]: from the one border to the other."""
        inner, outer = self.beside
        return norm(outer - inner)

    @cached_property
    def steps(self) -> Floats:
        """From each waypoint to the next, (N,) [m]; (N - 1,) of an open track."""
        return steps_of(self.center, self.closed)

    @cached_property
    def along(self) -> Floats:
        """From the start line to each waypoint along the centre line, (N,) [m]; the first is 0."""
        return np.concatenate(([0.0], np.cumsum(self.steps)))[: len(self.center)]

    @cached_property
    def length(self) -> float:
        """Of the centre line, straight from waypoint to waypoint [m]."""
        return float(np.cumsum(self.steps)[-1])

    @cached_property
    def direction(self) -> Direction | Literal["open"]:
        """In which it is driven; ``open``: from its first waypoint to its last."""
        if not self.closed:
            return OPEN
        return COUNTER_CLOCKWISE if area_of(self.center) > 0 else CLOCKWISE

    @cached_property
    def least_radius(self) -> float:
        """Of the tightest curve of the centre line [m]; that of a straight line is 10 km."""
        return min(float(radii_of(self.center, self.closed).min()), FARTHEST)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of :meth:`rows` as little-endian float64, in hexadecimal digits: two tracks with one digest are the same road."""
        return hashlib.sha256(self.rows().astype("<f8").tobytes()).hexdigest()

    def rows(self) -> Floats:
        """The track as it stands in files, (N + 1, 6): centre x and y, inner x and y, outer x and y [m]; the last row is the first.

        Of an open track (N, 6).
        """
        rows = np.hstack((self.center, self.inner, self.outer))
        return np.vstack((rows, rows[:1])) if self.closed else rows

    def line(self) -> Floats:
        """The waypoints as files and reward functions have them, (N + 1, 2) [m]; (N, 2) of an open track."""
        return self.rows()[:, :2]

    def turned_round(self) -> Track:
        """The same road driven the other way: a loop from the same start line, an open track from its end."""
        if not self.closed:
            return Track(self.name, self.center[::-1], self.outer[::-1], self.inner[::-1], closed=False)
        order = np.concatenate(([0], np.arange(len(self.center) - 1, 0, -1)))
        return Track(self.name, self.center[order], self.inner[order], self.outer[order])

    def facts(self) -> dict[str, Any]:
        """The track's facts as JSON values; lengths in metres."""
        return {
            "name": self.name,
            "length": self.length,
            "width": [float(self.width.min()), float(self.width.max())],
            "least_radius": self.least_radius,
            "direction": self.direction,
            "closed": self.closed,
            "waypoints": len(self.center),
            "digest": self.digest,
        }
