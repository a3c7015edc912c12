"""A track as a picture: road, borders, waypoints, start line and driving direction."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from racer.tracks.geometry import place_at
from racer.tracks.race_track import Track

_ASPHALT, _BORDER, _CENTER, _START = "#d9dce1", "#30343b", "#e08a1e", "#c0202a"
_SIDE = 6.0
"""Of the longer side of the road's surroundings in the picture [inch]."""
_NUMBERS = 12
"""Waypoints whose numbers are written, about."""


def picture_of(track: Track) -> bytes:
    """A PNG of the track, with its measures. Raises ImportError where matplotlib is not installed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path
    from PIL import Image

    low, high = np.minimum(track.inner, track.outer).min(axis=0), np.maximum(track.inner, track.outer).max(axis=0)
    span = high - low
    margin = 0.06 * span.max()
    size = (span + 2 * margin) * _SIDE / (span.max() + 2 * margin)
    figure = Figure(figsize=(max(size[0], 4.5) + 0.6, max(size[1], 2.0) + 1.1), dpi=100, layout="constrained")
    axes = figure.subplots()
    borders = track.outer, track.inner[::-1]
    rings = [np.vstack((ring, ring[:1])) for ring in (borders if track.closed else [np.vstack(borders)])]
    codes = [[Path.MOVETO, *[Path.LINETO] * (len(ring) - 2), Path.CLOSEPOLY] for ring in rings]
    axes.add_patch(PathPatch(Path(np.vstack(rings), np.concatenate(codes)), facecolor=_ASPHALT, edgecolor="none"))
    for ring in rings if track.closed else borders:
        axes.plot(*ring.T, color=_BORDER, linewidth=1.4)
    axes.plot(*track.center.T, ".", color=_CENTER, markersize=2.6)
    _number(axes, track)
    _start(axes, track)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(track.name, fontsize=13, fontweight="bold")
    axes.set_title(_measures(track), fontsize=9, color="#555555")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    small = io.BytesIO()  # few colours: a third of the size
    Image.open(buffer).convert("RGB").quantize(128).save(small, "PNG", optimize=True)
    return small.getvalue()


def _measures(track: Track) -> str:
    least, most = track.width.min(), track.width.max()
    width = f"{least:.2f} m" if most - least < 0.005 else f"{least:.2f} to {most:.2f} m"
    return (
        f"length {track.length:.2f} m, width {width}, tightest radius {track.least_radius:.2f} m,\n"
        f"{len(track.center)} waypoints, {track.direction}"
    )


def _number(axes: Any, track: Track) -> None:
    """Write the numbers of some waypoints on the inner half of the road; that of the start line is 0."""
    count = len(track.center)
    every = next(step for step in (5, 10, 20, 25, 50, 100, 250, 500) if count / step <= 1.5 * _NUMBERS)
    for row in range(every, count - every // 2, every):
        place = track.center[row] + 0.6 * (track.beside[0][row] - track.center[row])
        axes.text(*place, str(row), fontsize=7, color="#555555", ha="center", va="center")


def _start(axes: Any, track: Track) -> None:
    """Draw the start line across the road, and an arrow in driving direction."""
    inner, outer = (border[0] for border in track.beside)
    axes.plot(*np.vstack((inner, outer)).T, color=_START, linewidth=3, solid_capstyle="butt")
    width = float(track.width[0])
    (tail, tip), _ = place_at(track, [0.25 * width, 1.25 * width])
    beside = 0.25 * (outer - track.center[0])
    arrow = {"arrowstyle": "-|>", "color": _START, "linewidth": 1.8, "mutation_scale": 14, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=tip + beside, xytext=tail + beside, arrowprops=arrow)
