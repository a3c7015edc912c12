"""``python -m worker.train``: one rank of a training job, started by the supervisor (or by torchrun) with the job in its environment."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from worker.learning.job import Job, StopRequest, run_command, user_errors
from worker.settings.errors import UserError
from worker.telemetry.tracking_processes import Tracking

if TYPE_CHECKING:
    from worker.learning.hooks import Hook
    from worker.tasks.run.task import Task
    from worker.telemetry.picture import EpisodePicture

SWITCH_SECONDS = 0.0005
"""Longest time for which a reporting or saving thread may hold the interpreter, while the training thread's device may be idle [s]."""


def main() -> int:
    """Train; returns the exit code."""
    stop = StopRequest().listen()  # before the imports, which take seconds
    sys.setswitchinterval(SWITCH_SECONDS)
    job = Job.from_env(os.environ, "train")
    with Tracking(job, is_main=os.environ.get("RANK", "0") == "0") as tracking:
        return tracking.ended(_train(job, stop, tracking))


def _train(job: Job, stop: StopRequest, tracking: Tracking) -> int:
    from worker.learning.startup import Startup

    startup = Startup()
    from worker.learning.distributed import connect_rank

    startup.mark("torch")
    gang = connect_rank(os.environ)
    startup.mark("gang")
    if not isinstance(job.section.get("task"), str):
        raise UserError("train.task: the name of a task is missing")
    from worker.tasks import find_task

    with user_errors("train.task"):
        task_type = find_task(job.section["task"])
    from worker.learning.leaving import train
    from worker.learning.loop import Loop
    from worker.learning.memory_estimate import within_memory
    from worker.learning.setup import total_worlds
    from worker.learning.training import Training

    training = Training.of(job, task_type)
    startup.mark("task and simulator")
    tracking.check()
    learner = training.algorithm_type, training.settings
    worlds = -(-total_worlds(job, gang) // gang.size)
    loop: Loop | None = None
    # All memory is allocated in the first iterations; a later out-of-memory error has another cause.
    with within_memory(task_type, training.config, learner, worlds, gang, lambda: loop is None or loop.iterated < 3):
        loop = Loop(training, gang, stop, [startup, *hooks()])
        startup.mark("worlds and learner")
        code = train(loop, stop)
    loop.close()
    return code


def hooks() -> list[Hook]:
    """The hooks of every training: its tap, and its final evaluation."""
    from worker.evaluation.final_evaluation import FinalEvaluation
    from worker.telemetry.tap import LiveTap

    def draw(worlds: Task) -> EpisodePicture:
        from worker.telemetry.picture import EpisodePicture  # it takes a while, and most jobs of a sweep draw nothing

        return EpisodePicture(worlds)

    return [LiveTap(), FinalEvaluation(None if os.environ.get("MUSTER_PICTURE") == "0" else draw)]


if __name__ == "__main__":
    run_command(main)
