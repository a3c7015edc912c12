"""The final evaluation of a training: the policy is evaluated, the curve plotted, a picture drawn."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from shared_store.contract.phases import Phase
from shared_store.volume.files import write_atomic
from shared_store.volume.layout import Run
from shared_store.volume.metrics import read_metrics
from worker.evaluation.evaluation import best_line, evaluate
from worker.learning.algorithm import WorldShare
from worker.learning.hooks import Hook
from worker.learning.randomness import held_out_seed
from worker.learning.setup import build_task
from worker.tasks.run.adapting import adaptive_steps, begin_evaluation

if TYPE_CHECKING:
    from worker.learning.loop import Loop
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task


EVALUATED = 256
"""Greatest number of worlds that a rank builds for the evaluation: the worlds of training still hold their memory."""


class Drawing(Protocol):
    """Watches worlds while a policy is evaluated in them, and draws what it saw."""

    def picture(self, config: TaskConfig, count: Callable[[int, int], None]) -> bytes:
        """The drawing as PNG. ``count``: called with how much of it is done, and how much there is."""


class FinalEvaluation(Hook):
    """Evaluates the policy of the last checkpoint.

    Args:
        draw: Begins a drawing of the evaluation's worlds, on the main rank; None for a training without a picture.
    """

    def __init__(self, draw: Callable[[Task], Drawing] | None = None) -> None:
        self._draw = draw

    def trained(self, loop: Loop, checkpoint: str) -> None:
        """Evaluate the policy, plot the curve, print the paths; the picture comes last."""
        loop.say(f"evaluating checkpoint {checkpoint}")
        loop.beacon.enter(Phase.EVALUATING)
        worlds = held_out_worlds(loop)
        drawing = self._draw(worlds) if self._draw and loop.gang.is_main else None
        count = partial(loop.beacon.enter, Phase.EVALUATING)
        result = evaluate(worlds, loop.algorithm.policy(), loop.gang, checkpoint=checkpoint, count=count)
        loop.say(str(result))
        if not loop.gang.is_main:
            return
        run, plot = loop.job.run, None
        loop.beacon.enter(Phase.WRITING)
        try:
            result.write(run, iteration=loop.state.progress.iteration, config={})
            plot = plot_reward(run)
        except (OSError, ValueError) as error:
            loop.say(f"warning: the evaluation or the plot could not be written ({error})")
        loop.say(f"last checkpoint: {run.checkpoints / checkpoint}")
        if best := best_line(run):
            loop.say(best)
        if plot:
            loop.say(f"reward plot: {plot}")
        if drawing:
            loop.beacon.enter(Phase.DRAWING)
            path = run.metrics / "policy.png"
            try:
                write_atomic(path, drawing.picture(loop.config, partial(loop.beacon.enter, Phase.DRAWING)))
                loop.say(f"picture of the policy: {path}")
            except Exception as error:  # it does not fail the training
                loop.say(f"warning: the picture of the policy could not be made ({type(error).__name__}: {error})")


def held_out_worlds(loop: Loop) -> Task:
    """The worlds of the evaluation: those of training, or, if worlds are drawn at random, others with another seed."""
    worlds, progress = loop.task, loop.state.progress
    if loop.config.randomize.draws_worlds:
        total = min(loop.share.total, EVALUATED * loop.gang.size)
        share = WorldShare.of(loop.gang.rank, loop.gang.size, total)
        seed = held_out_seed(loop.training.seed)
        worlds = build_task(type(loop.task), loop.config, share, loop.gang, seed)
    last = max(0, progress.iteration - 1)
    begin_evaluation(worlds, last, progress.reward, progress.episode_length, adaptive_steps(loop.task))
    return worlds


def plot_reward(run: Run, path: Path | None = None) -> Path:
    """Draw mean return, and the metric that the task shows or the mean episode length, over environment steps.

    Returns the path, by default ``metrics/reward.png``. Raises ValueError where the run has no finished episode yet.
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
    # beside the return the metric that the task shows, else the episodes' length
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
