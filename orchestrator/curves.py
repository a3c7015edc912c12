"""The learning curves of several runs as a PNG file, drawn without a display."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from orchestrator.compared import Group
from shared_store.files import write_atomic


def draw(groups: Sequence[Group], path: Path) -> None:
    """Draw mean return over environment steps, one line a group with a band of ± one standard deviation over its runs.

    Raises ValueError where no run has a finished episode yet, OSError.
    """
    curves = [(group.label, group.curve()) for group in groups]
    if not any(curve for _, curve in curves):
        raise ValueError("no episode of these runs has finished yet, there is nothing to draw")
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
    figure.savefig(buffer, format="png")
    write_atomic(path.absolute(), buffer.getvalue())
