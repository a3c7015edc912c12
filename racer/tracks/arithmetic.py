"""Arithmetic with the same bits on every machine: sines, cosines, lengths, and distances to lines.

Libraries that compute sines differ in their last digits from processor to processor. Sums, products, quotients and square roots do not:
IEEE 754 rounds them in one way. Made tracks use nothing else, so a seed means the same bytes everywhere.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_TURN = 2 * math.pi
BLOCK = 1 << 20
"""Pairs of a point and a segment that are looked at together."""
_TERMS = 15
"""Of the Taylor series; at half a turn the next one is below 1e-17."""


def sine_cosine(angle: Any) -> tuple[Floats, Floats]:
    """Sine and cosine, to about 1e-15.

    Args:
        angle: Any shape, float64 [rad], a few turns at most.
    """
    angle = np.asarray(angle, np.float64)
    rest = angle - _TURN * np.rint(angle / _TURN)
    square = rest * rest
    sine, cosine = np.ones_like(rest), np.ones_like(rest)
    for term in range(_TERMS, 0, -1):
        sine = 1 - square / (2 * term * (2 * term + 1)) * sine
        cosine = 1 - square / (2 * term * (2 * term - 1)) * cosine
    return rest * sine, cosine


def norm(vectors: Floats) -> Floats:
    """Lengths of vectors (…, 2)."""
    lengths: Floats = np.sqrt(vectors[..., 0] * vectors[..., 0] + vectors[..., 1] * vectors[..., 1])
    return lengths


def left_of(vectors: Floats) -> Floats:
    """Vectors (…, 2), turned left by a right angle."""
    return np.stack((-vectors[..., 1], vectors[..., 0]), -1)


def cross(first: Floats, second: Floats) -> Floats:
    """The cross product of vectors (…, 2): greater than 0 where ``second`` points left of ``first``."""
    product: Floats = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return product


def segments_of(line: Floats, closed: bool = True) -> tuple[Floats, Floats]:
    """Where the segments of a line (N, 2) begin and end, two of (S, 2): S is N, or N - 1 where its last point does not lead to the first."""
    return (line, np.roll(line, -1, axis=0)) if closed else (line[:-1], line[1:])


def nearest(line: Floats, points: Floats, closed: bool = True) -> tuple[NDArray[np.int64], Floats]:
    """The place on a line that is nearest to each of ``points`` (P, 2); of several the first one.

    Returns:
        The segment, (P,), and where on it the place lies, (P,) from 0 to 1.
    """
    start, end = segments_of(line, closed)
    segment, steps = end - start, norm(end - start)
    squared = np.maximum(steps * steps, 1e-12)  # a border may stand still
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


def nearest_points(line: Floats, points: Floats, closed: bool = True) -> Floats:
    """The points of a line (N, 2) that are nearest to ``points``, (P, 2)."""
    row, share = nearest(line, points, closed)
    start, end = segments_of(line, closed)
    found: Floats = start[row] + share[:, None] * (end[row] - start[row])
    return found


def meetings(start: Floats, end: Floats, points: Floats) -> NDArray[np.int64]:
    """Number of segments from ``start`` (N, 2) to ``end`` that a ray to the right from each of ``points`` (P, 2) meets, as (P,).

    Of a closed ring it is odd for a point inside.
    """
    rise = end[:, 1] - start[:, 1]
    slope = (end[:, 0] - start[:, 0]) / np.where(rise == 0, 1.0, rise)
    found = np.empty(len(points), np.int64)
    size = max(1, BLOCK // len(start))
    for begin in range(0, len(points), size):
        x, y = points[begin : begin + size, None, 0], points[begin : begin + size, None, 1]
        rises = (start[:, 1] > y) != (end[:, 1] > y)
        found[begin : begin + size] = (rises & (x < start[:, 0] + (y - start[:, 1]) * slope)).sum(axis=1)
    return found
