"""The learning curves of several runs: as a picture, drawn without a display, or as numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from shared_store.volume.comparison import RunGroup
from shared_store.volume.files import EVERY_LEVEL, write_atomic

Curves = Sequence[tuple[str, Sequence[tuple[float, float, float, int]]]]


ENDINGS = (".png", ".svg", ".pdf", ".csv")
"""Endings of the files that can be written."""


def draw(groups: Sequence[RunGroup], path: Path) -> None:
    """Write each group's mean return over environment steps, with one standard deviation over its runs.

    The file is a picture with one line and band per group, or a table of ``group``, ``env_steps``, ``return``, ``std`` and ``runs``.

    Raises ValueError if no run has a finished episode yet, ImportError for a picture without matplotlib, OSError.

    Args:
        groups: The groups to draw.
        path: A file with one of :data:`ENDINGS`.
    """
    curves = [(group.label, group.curve()) for group in groups]
    if not any(curve for _, curve in curves):
        raise ValueError("no episode of these runs has finished yet, so nothing can be drawn")
    content = _table(curves) if path.suffix == ".csv" else _picture(curves, path.suffix[1:])
    write_atomic(path.absolute(), content, levels=EVERY_LEVEL)


def _table(curves: Curves) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "env_steps", "return", "std", "runs"])
    writer.writerows([label, *point] for label, curve in curves for point in curve)
    return text.getvalue().encode()


def _picture(curves: Curves, kind: str) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for label, curve in curves:
        if not curve:
            continue
        steps, means, spreads, counts = zip(*curve, strict=True)
        (line,) = axes.plot(steps, means, label=label, marker="." if len(steps) < 30 else None)
        if max(counts) > 1:
            low = [mean - spread for mean, spread in zip(means, spreads, strict=True)]
            high = [mean + spread for mean, spread in zip(means, spreads, strict=True)]
            axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="environment steps", ylabel="mean return of finished episodes")
    axes.grid(alpha=0.3)
    axes.legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind)
    return buffer.getvalue()
