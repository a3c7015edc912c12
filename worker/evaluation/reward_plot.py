"""The reward plot of a run: its learning curve as a PNG file."""

from __future__ import annotations

import io
import math
from pathlib import Path

from shared_store.volume.files import write_atomic
from shared_store.volume.layout import Run
from shared_store.volume.metrics import read_metrics


def plot_reward(run: Run, path: Path | None = None) -> Path:
    """Draw mean return, and the metric that the task shows or the mean episode length, over environment steps; returns where (``metrics/reward.png`` by default).

    Raises ValueError where the run has no finished episode yet.
    """
    records = [record for record in read_metrics(run) if record.get("reward") is not None]
    if not records:
        raise ValueError(f"run {run.name}: no episode has finished yet, there is nothing to draw")
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    path = path or run.metrics / "reward.png"
    figure = Figure(figsize=(7, 4), dpi=120, layout="constrained")
    axes = figure.subplots()
    steps = [record["env_steps"] for record in records]
    axes.plot(
        steps, [record["reward"] for record in records], color="tab:blue", marker="." if len(steps) < 30 else None
    )
    axes.set(title=run.name, xlabel="environment steps")
    axes.set_ylabel("mean return of finished episodes", color="tab:blue")
    axes.grid(alpha=0.3)
    # beside the return what the task wants to be seen, else how long episodes are
    name = next((name for record in records for name in record.get("shown", {})), None)
    label = "mean episode length [steps]"
    if name is not None:
        unit = next(record["shown"][name].partition(" ")[2] for record in records if name in record.get("shown", {}))
        label = f"mean {name}" + f" [{unit}]" * bool(unit)
    values = [record.get(f"metric_{name}" if name else "episode_length") for record in records]
    others = axes.twinx()
    others.plot(steps, [math.nan if value is None else value for value in values], color="tab:orange", linewidth=1)
    others.set_ylabel(label, color="tab:orange")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomic(path, buffer.getvalue())
    return path
