"""A task's report to the training loop: its metrics, functions of the user such as a learner's reward, control steps, shared counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

    from shared_store.volume.layout import Run
    from worker.tasks.run.step_log import StepLog


class TaskReport:
    """A task that shows no metric, has no function of the user, logs no control steps and shares no counts; others override this."""

    final_metrics: tuple[str, ...] = ()
    """Metrics whose value at an episode's last step counts."""
    shown_metrics: Mapping[str, str] = {}
    """Metrics that a training's progress shows, and their units."""

    waits_for_host: bool = False
    """Whether a step reads data back to the host, so that no graph can hold it."""

    def notes(self) -> Sequence[str]:
        """Lines about them, for the start of a training's log."""
        return ()

    def failures(self) -> Mapping[str, tuple[int, int]]:
        """Errors in them since the task was built; waits for the device.

        Returns:
            By error line: its count, and the first world, counted over all ranks; the most frequent first.
        """
        return {}

    def is_users_fault(self, cause: str) -> bool:
        """Whether a function of the user is to blame for a failed world (:meth:`worker.tasks.run.task.Task.read_failed_world`), which another attempt repeats."""
        return False

    def begins_anew(self) -> str:
        """What a training that is resumed does not find again, one line; empty: nothing."""
        return ""

    def step_log(self, run: Run, steps: int, iteration: int, facts: Mapping[str, Any]) -> StepLog | None:
        """A log of the control steps of a training that begins or goes on, on the main rank; None: the task keeps none.

        Args:
            run: The run.
            steps: Control steps of an iteration.
            iteration: Iterations done.
            facts: The entries of a checkpoint's manifest about the policy.

        Raises:
            OSError: The store can't be written.
            DamagedFile: A link is in the place of one of its directories.
        """
        return None

    def own_counts(self) -> Mapping[str, torch.Tensor]:
        """Counts of this rank's worlds that decide together with those of other ranks, by name; integers on the device."""
        return {}

    def take_counts(self, others: Mapping[str, torch.Tensor]) -> None:
        """Called before every iteration of a gang's training with the sums of the other ranks' :meth:`own_counts`."""
