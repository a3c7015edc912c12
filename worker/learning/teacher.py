"""The teacher of an algorithm that imitates another run's policy (:class:`worker.learning.algorithm.Student`)."""

from __future__ import annotations

from typing import Any

from shared_store.volume.checkpoints import Checkpoint
from worker.learning.algorithm import Algorithm, Student
from worker.learning.distributed import Gang
from worker.learning.job import Job, user_errors
from worker.learning.trained import choose_checkpoint, load_learner
from worker.settings.errors import UserError


def give_teacher(job: Job, gang: Gang, algorithm: Algorithm, adopted: Checkpoint | None) -> None:
    """Load the weights of the teacher that a new run's settings name. All ranks call it.

    Args:
        job: The job, in the same store as the teacher's run.
        gang: The ranks.
        algorithm: The algorithm, with or without a teacher.
        adopted: The checkpoint with the run's initial weights; if it was made with the same teacher, it holds the teacher.

    Raises:
        UserError: The checkpoint does not exist, is of an older Muster, or its weights do not fit.
    """
    if not isinstance(algorithm, Student) or not (reference := algorithm.teacher_checkpoint):
        return
    if adopted and (adopted.manifest.get("settings") or {}).get("teacher_checkpoint") == reference:
        return
    learnt = _learnt(job, gang, reference)
    with user_errors("train"):
        algorithm.load_teacher(learnt)


def _learnt(job: Job, gang: Gang, reference: str) -> dict[str, Any]:
    """The algorithm's state in the checkpoint ``RUN`` or ``RUN@ITERATION``."""
    name, _, iteration = reference.partition("@")
    copy = job.run.teacher(name)  # chosen when the job was submitted, unless the teacher's run did not exist yet
    held = gang.tell("held" if copy.checkpoints.is_dir() else None)
    checkpoint = choose_checkpoint(gang, copy if held else job.store.run(name), iteration or None)
    if "algorithm" not in checkpoint.manifest:
        raise UserError(
            f"teacher_checkpoint: checkpoint {checkpoint.name} of run {name} is of an older Muster, which knew no algorithms; "
            "train the teacher again"
        )
    learnt: dict[str, Any] = load_learner(checkpoint, gang.device)["algorithm"]
    return learnt
