"""What follows the last iteration: its checkpoint is saved, the policy evaluated, the curve plotted, a picture drawn."""

from __future__ import annotations

import os
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING

from shared_store.contract.phases import Phase
from shared_store.volume.files import write_atomic
from worker.evaluation.evaluation import best_words, evaluate
from worker.learning.algorithm import Share
from worker.learning.randomness import held_out_seed
from worker.learning.setup import build_task
from worker.settings.errors import TrainingError
from worker.tasks.run.adapting import adaptive_steps, begin_evaluation

if TYPE_CHECKING:
    from worker.learning.loop import Loop
    from worker.tasks.run.task import Task
    from worker.telemetry.picture import Glance


EVALUATED = 256
"""Greatest number of worlds that a rank builds for the evaluation: the worlds of training still hold their memory."""
LONGEST_PAUSE = 30
"""Seconds between two tries to save the last checkpoint, at most."""


def complete(loop: Loop) -> None:
    """Save the last checkpoint, evaluate the policy, plot the curve, print the paths. All ranks call it.

    Raises TrainingError where the gang is asked to exit before the store takes the checkpoint.
    """
    loop.beacon.tell(
        done=True, phase=Phase.SAVING
    )  # training is over: a slow volume must not look like a stalled iteration
    name = _save(loop)
    loop.failures.tell(again=True)
    loop.say(f"evaluating checkpoint {name}")
    worlds = held_out_worlds(loop)
    glance = _glance(loop, worlds)
    loop.beacon.tell(phase=Phase.EVALUATING)
    result = evaluate(worlds, loop.algorithm.policy(), loop.gang, checkpoint=name)
    loop.say(str(result))
    if not loop.gang.is_main:
        return
    run, plot = loop.job.run, None
    loop.beacon.tell(phase=Phase.WRITING)
    try:
        result.write(run, iteration=loop.state.progress.iteration, config={})
        from worker.telemetry.reward_plot import plot_reward

        plot = plot_reward(run)
    except (OSError, ValueError) as error:
        loop.say(f"warning: the evaluation or the plot could not be written ({error})")
    loop.say(f"last checkpoint: {run.checkpoints / name}")
    if best := best_words(run):
        loop.say(best)
    if plot:
        loop.say(f"reward plot: {plot}")
    if glance:
        loop.beacon.tell(phase=Phase.DRAWING)
        _show(loop, glance, run.metrics / "policy.png")


def _save(loop: Loop) -> str:
    """Save the last checkpoint until the store takes it; returns its name."""
    state, gang, pause = loop.state, loop.gang, 1
    if state.ordered_at != state.progress.iteration:
        _order(loop)
    while True:
        loop.tell_saved(state.finish())
        name = gang.tell(state.saved_at) or ""
        if name.startswith(f"{state.progress.iteration:08d}-"):
            return name
        loop.say(f"training is done, and its last checkpoint is not saved yet; trying again in {pause} s")
        for _ in range(pause):  # of a second: the gang has little time to exit
            if gang.greatest(int(loop.stop.requested)):
                raise TrainingError(
                    "training is done, but its last checkpoint could not be saved; free space in the store and start again"
                )
            sleep(1.0)
        _order(loop)
        pause = min(2 * pause, LONGEST_PAUSE)


def _order(loop: Loop) -> None:
    loop.state.save(loop.reporter if loop.gang.is_main else None)


def held_out_worlds(loop: Loop) -> Task:
    """The worlds of the evaluation: those of training, or, if worlds are drawn at random, others with another seed."""
    worlds, progress = loop.task, loop.state.progress
    if loop.config.randomize.draws_worlds:
        total = min(loop.share.total, EVALUATED * loop.gang.size)
        share = Share.of(loop.gang.rank, loop.gang.size, total)
        seed = held_out_seed(loop.training.seed)
        worlds = build_task(type(loop.task), loop.config, share, loop.gang, seed, loop.beacon)
    last = max(0, progress.iteration - 1)
    begin_evaluation(worlds, last, progress.reward, progress.episode_length, adaptive_steps(loop.task))
    return worlds


def _glance(loop: Loop, worlds: Task) -> Glance | None:
    """The observer of the evaluation, if the job asks for a picture."""
    if not loop.gang.is_main or os.environ.get("MUSTER_PICTURE") == "0":
        return None
    from worker.telemetry.picture import Glance

    return Glance(worlds)


def _show(loop: Loop, glance: Glance, path: Path) -> None:
    """Write the picture. An error here does not fail the training."""
    try:
        write_atomic(path, glance.picture(loop.config))
        loop.say(f"picture of the policy: {path}")
    except Exception as error:
        loop.say(f"warning: the picture of the policy could not be made ({type(error).__name__}: {error})")
