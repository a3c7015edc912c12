"""Track presets of exact straights and arcs: ``oval``, ``rounded-rectangle``, ``chicane``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from racer.tracks.arithmetic import Floats, left_of, sine_cosine
from racer.tracks.checks import LENGTHS, WAYPOINTS, WIDTHS, BadTrack
from racer.tracks.race_track import CLOCKWISE, COUNTER_CLOCKWISE, DIRECTIONS, Direction, Track
from shared_store.contract.error_text import nearest

WIDTH = 1.0
"""Of a made road [m]."""
SPACING = 0.15
"""Of a made road's waypoints [m]."""
SPACINGS = (0.02, 0.5)
"""Allowed range [m]."""
_INSIDE = 0.1
"""Least radius of the inner border of a made curve [m]."""


@dataclass(frozen=True)
class Part:
    """A straight or an arc, in the preset's own unit of length.

    Args:
        length: Along the centre line.
        turn: By which the heading has changed at its end [rad], greater than 0 to the left; 0 for a straight.
    """

    length: float
    turn: float = 0.0

    @classmethod
    def arc(cls, radius: float, turn: float) -> Part:
        return cls(radius * abs(turn), turn)


@dataclass(frozen=True)
class Preset:
    """A loop that is half of it, twice: a half that turns by π in all closes whatever its parts are.

    Args:
        half: The parts, from the start line on.
        length: Of the whole loop where none is asked for [m].
        about: What it looks like.
    """

    half: tuple[Part, ...]
    length: float
    about: str


_S = (Part.arc(1, math.pi / 3), Part.arc(1, -math.pi / 3))
PRESETS = {
    "oval": Preset(
        (Part(1), Part.arc(1, math.pi), Part(1)),
        20.0,
        "two half circles of radius r and two straights of 2 r; the length is (2 π + 4) r",
    ),
    "rounded-rectangle": Preset(
        (Part(2.5), Part.arc(1, math.pi / 2), Part(2), Part.arc(1, math.pi / 2), Part(2.5)),
        28.0,
        "four quarter circles of radius r, straights of 5 r and 2 r; the length is (2 π + 14) r",
    ),
    "chicane": Preset(
        (
            Part(1),
            *_S,
            Part(1),
            *(Part(part.length, -part.turn) for part in _S),
            Part(2),
            Part.arc(2.5, math.pi),
            Part(1),
        ),
        40.0,
        "each long side leads inwards and out again in arcs of radius r by 60°, the ends are half circles of 2.5 r; "
        "the length is (23 π / 3 + 10) r",
    ),
}


def make_preset(
    preset: str,
    name: str | None = None,
    *,
    length: float | None = None,
    width: float = WIDTH,
    spacing: float = SPACING,
    direction: Direction = COUNTER_CLOCKWISE,
) -> Track:
    """A track of exact straights and arcs, its waypoints evenly spaced along them, its centre at the origin.

    Args:
        preset: One of :data:`PRESETS`.
        name: Of the track; that of the preset by default.
        length: Of the centre line [m]; the preset's own by default.
        width: Of the road [m].
        spacing: Between waypoints, as nearly as a whole number of them allows [m].
        direction: In which it is driven.

    Raises:
        BadTrack: There is no such preset, or the road does not fit its curves.
    """
    if preset not in PRESETS:
        raise BadTrack(f"preset {preset}: there is no such preset; {nearest(preset, PRESETS)}")
    found = PRESETS[preset]
    length = found.length if length is None else length
    check_measures(length, width, spacing, direction)
    parts = found.half * 2
    unit = length / math.fsum(part.length for part in parts)
    radius = unit * min(part.length / abs(part.turn) for part in parts if part.turn)
    check_room(preset, radius, length, width)
    center, headings = _followed(parts, unit, length * np.arange(count := waypoints(length, spacing)) / count)
    sine, cosine = sine_cosine(headings)
    left = left_of(np.stack((cosine, sine), -1)) * (width / 2)
    track = Track(name or preset, center, center + left, center - left)
    return track.turned_round() if direction == CLOCKWISE else track


def check_measures(length: float, width: float, spacing: float, direction: str) -> None:
    """Raise BadTrack for measures that no track is made with."""
    limits = {"length": (length, LENGTHS), "width": (width, WIDTHS), "spacing": (spacing, SPACINGS)}
    for what, (value, (least, most)) in limits.items():
        if not least <= value <= most:
            raise BadTrack(f"{what} {value:g} m: expected {least:g} to {most:g} m")
    if direction not in DIRECTIONS:
        raise BadTrack(f"direction {direction}: {nearest(direction, DIRECTIONS)}")
    if not WAYPOINTS[0] <= waypoints(length, spacing) <= WAYPOINTS[1]:
        raise BadTrack(
            f"length {length:g} m with a waypoint every {spacing:g} m: that makes {waypoints(length, spacing)} of them, expected "
            f"{WAYPOINTS[0]} to {WAYPOINTS[1]}; change the spacing"
        )


def check_room(what: str, radius: float, length: float, width: float) -> None:
    """Raise BadTrack where the inner border would have no room in the tightest curve."""
    if radius - _INSIDE < width / 2:
        raise BadTrack(
            f"{what} of {length:g} m: its tightest curve has a radius of {radius:.2f} m, too little for a road of {width:g} m; "
            f"make it longer, or the road at most {math.floor(200 * (radius - _INSIDE)) / 100:.2f} m wide"
        )


def waypoints(length: float, spacing: float) -> int:
    """Number of waypoints of a made track."""
    return round(length / spacing)


def _followed(parts: tuple[Part, ...], unit: float, stations: Floats) -> tuple[Floats, Floats]:
    """Points (N, 2) [m] and headings (N,) [rad] at ``stations`` (N,) [m] of a loop of ``parts``; its centre is the origin."""
    points, headings = np.empty((len(stations), 2)), np.empty(len(stations))
    begin, place, heading = 0.0, np.zeros(2), 0.0
    middle = place
    for number, part in enumerate(parts):
        if number == len(parts) // 2:
            middle = place / 2  # half of the way the loop is on the other side of its centre
        length = part.length * unit
        here = (stations >= begin) if number == len(parts) - 1 else (stations >= begin) & (stations < begin + length)
        points[here], headings[here] = _along(part, unit, place, heading, stations[here] - begin)
        ends, turned = _along(part, unit, place, heading, np.array([length]))
        begin, place, heading = begin + length, ends[0], float(turned[0])
    return points - middle, headings


def _along(part: Part, unit: float, place: Floats, heading: float, distances: Floats) -> tuple[Floats, Floats]:
    """Points and headings at ``distances`` [m] behind the beginning of a part, which lies at ``place`` with ``heading``."""
    headings = heading + part.turn * (distances / (part.length * unit))
    sine, cosine = sine_cosine(headings)
    if part.turn == 0:
        return place + distances[:, None] * np.stack((cosine, sine), -1), headings
    radius = part.length * unit / part.turn  # less than 0 to the right
    first_sine, first_cosine = sine_cosine(heading)
    return place + radius * np.stack((sine - first_sine, first_cosine - cosine), -1), headings
