"""The generator of tracks from a seed: closed curves whose radius about the middle is a sum of waves.

The same seed and measures give the same bytes on every machine (:mod:`racer.tracks.arithmetic`), in every version of Muster: a job
names a track as ``random:SEED``.
"""

from __future__ import annotations

import random

import numpy as np

from racer.tracks.arithmetic import Floats, left_of, norm, sine_cosine
from racer.tracks.checks import BadTrack, radii_of
from racer.tracks.presets import SPACING, WIDTH, check_measures, check_room, waypoints
from racer.tracks.race_track import CLOCKWISE, COUNTER_CLOCKWISE, Direction, Track

LENGTH = 30.0
"""Of the centre line [m]."""
ROUGHNESS = 0.7
LEAST_RADIUS = 0.75
"""Of curves [m]."""
LARGEST_SEED = 2**63 - 1
_HARMONICS = range(2, 7)
_TRIES = 200
_FINE = 4096
"""Points of a curve before its waypoints are laid."""
_START = 3.0
"""About the start line this much of the track is as straight as any [m]."""
_MIDDLE = 0.25
"""The curve stays away from the middle by this share of its mean radius."""


def make_random(
    seed: int,
    name: str | None = None,
    *,
    length: float = LENGTH,
    width: float = WIDTH,
    spacing: float = SPACING,
    roughness: float = ROUGHNESS,
    least_radius: float = LEAST_RADIUS,
    direction: Direction = COUNTER_CLOCKWISE,
) -> Track:
    """A track drawn from ``seed``; curves that are too tight, or whose road would meet itself, are drawn again.

    Args:
        seed: 0 to :data:`LARGEST_SEED`.
        name: Of the track; ``random:SEED`` by default.
        length: Of the centre line [m].
        width: Of the road [m].
        spacing: Between waypoints [m].
        roughness: How far the waves of the radius go: 0 makes a circle, 1 is wild.
        least_radius: Of the tightest curve [m].
        direction: In which it is driven.

    Raises:
        BadTrack: A measure is out of range, or no curve fits in 200 tries.
    """
    check_measures(length, width, spacing, direction)
    if not 0 <= seed <= LARGEST_SEED:
        raise BadTrack(f"seed {seed}: expected an integer from 0 to {LARGEST_SEED}")
    if not 0 <= roughness <= 1:
        raise BadTrack(f"roughness {roughness:g}: expected 0 to 1")
    check_room("a random track", least_radius, length, width)
    if length / 6.2 < least_radius:
        raise BadTrack(f"a radius of {least_radius:g} m is not possible on {length:g} m; make the track longer")
    draws = random.Random(seed)
    count, problem = waypoints(length, spacing), ""
    for _ in range(_TRIES):
        center = _drawn(draws, length, count, roughness)
        if center is None:
            problem = "it came too near to its middle"
            continue
        if (radius := float(radii_of(center).min())) < least_radius:
            problem = f"its tightest curve had a radius of {radius:.2f} m"
            continue
        center = _from_straightest(center, length / count)
        left = _normals(center) * (width / 2)
        try:
            track = Track(name or f"random:{seed}", center, center + left, center - left)
        except BadTrack as error:
            problem = str(error)
            continue
        return track.turned_round() if direction == CLOCKWISE else track
    raise BadTrack(
        f"seed {seed}: none of {_TRIES} curves fits (of the last one, {problem}); make the track longer, the road narrower, the "
        "roughness or the least radius smaller"
    )


def _drawn(draws: random.Random, length: float, count: int, roughness: float) -> Floats | None:
    """``count`` points (N, 2) at equal distances on a closed curve of that length, counter-clockwise; None where it meets its middle."""
    angles = 2 * np.pi * np.arange(_FINE) / _FINE
    radius = np.ones(_FINE)
    for harmonic in _HARMONICS:
        sine, cosine = sine_cosine(harmonic * angles)
        height = 0.6 * roughness / harmonic
        radius = radius + height * (2 * draws.random() - 1) * cosine + height * (2 * draws.random() - 1) * sine
    if radius.min() < _MIDDLE:
        return None
    sine, cosine = sine_cosine(angles)
    fine = np.stack((radius * cosine, radius * sine), -1)
    closed = np.concatenate((fine, fine[:1]))
    steps = norm(closed[1:] - closed[:-1])
    ends = np.cumsum(steps)
    stations = ends[-1] * np.arange(count) / count
    before = np.searchsorted(ends, stations, side="right")  # the segment on which each of them lies
    share = (stations - (ends[before] - steps[before])) / steps[before]
    points: Floats = closed[before] + share[:, None] * (closed[before + 1] - closed[before])
    return points * (length / float(np.cumsum(norm(np.roll(points, -1, axis=0) - points))[-1]))


def _from_straightest(center: Floats, spacing: float) -> Floats:
    """The same ring (N, 2), begun in the middle of the piece that turns least: cars start there."""
    curvature = 1 / radii_of(center)
    reach = min(round(_START / 2 / spacing), len(center) // 4)
    total = curvature.copy()
    for row in range(1, reach + 1):
        total = total + np.roll(curvature, row) + np.roll(curvature, -row)
    return np.roll(center, -int(total.argmin()), axis=0)


def _normals(center: Floats) -> Floats:
    """Of length 1, to the left at each point of a ring (N, 2)."""
    tangents = np.roll(center, -1, axis=0) - np.roll(center, 1, axis=0)
    return left_of(tangents) / norm(tangents)[:, None]
