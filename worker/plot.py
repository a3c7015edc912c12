"""The learning curve of a run as a PNG file."""

from __future__ import annotations

import io
from pathlib import Path

from shared_store.files import write_atomic
from shared_store.layout import Run
from shared_store.metrics import read_metrics


def plot_reward(run: Run, path: Path | None = None) -> Path:
    """Draw mean return and mean episode length over environment steps; returns where (``metrics/reward.png`` by default).

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
    lengths = axes.twinx()
    lengths.plot(steps, [record["episode_length"] for record in records], color="tab:orange", linewidth=1)
    lengths.set_ylabel("mean episode length [steps]", color="tab:orange")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomic(path, buffer.getvalue())
    return path
