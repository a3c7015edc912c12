"""Records of ended episodes: sums of reward terms and metrics, cause of the end, success."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from shared_store.volume.evaluations import BY_CLOCK
from worker.simulation.episodes import PHYSICS_FAILED, STEPS, TERMS

if TYPE_CHECKING:
    from worker.tasks.run.buffers import Buffers
    from worker.tasks.run.task import Task

CLOCK = "time_out"


@dataclass(frozen=True)
class LastEpisodes:
    """The last finished episode of each world: live views, valid in every world that has finished one.

    Attributes:
        sums: Return, steps, the weighted sum of each reward term, the sum of each metric (for those in ``final`` the last value), shape
            ``(worlds, 2 + terms)``, float32.
        causes: Index into ``names`` of the cause of its end, shape ``(worlds,)``, int32. Of several terminations in one step, the first.
        judged: Whether it was a success by the task's criterion, shape ``(worlds,)``, bool; meaningless if ``success`` is None.
        names: Causes of an end: the clock (``time_out``), ``physics_failed``, ``terminated`` (none of the next), then the terminations.
        columns: Names of the columns of ``sums`` after the first two.
        success: The metric or termination that makes a success; None: only the clock ended the episode.
        says_success: Whether success is defined; without terminations and a criterion it is not.
        final: The metrics whose last step counts.
    """

    sums: torch.Tensor
    causes: torch.Tensor
    judged: torch.Tensor
    names: Sequence[str]
    columns: Sequence[str]
    success: str | None
    says_success: bool
    final: Sequence[str] = ()

    @classmethod
    def of(cls, task: Task, buffers: Buffers) -> LastEpisodes:
        """The records of ``task`` in its buffers."""
        rewards = [f"reward_{name}" for name in task.reward_terms]
        ends = [name.removeprefix("termination_") for name in task.termination_names]
        return cls(
            buffers["last_sums"],
            buffers["causes"],
            buffers["successes"],
            [CLOCK, "physics_failed", "terminated", *(name for name in ends if name != CLOCK)],
            [*rewards, *task.metric_names],
            task.success,
            task.success is not None or ends != [CLOCK],
            task.final_metrics,
        )

    @property
    def terms(self) -> torch.Tensor:
        """The weighted sum of each reward term, and the mean over the steps or the last value of each metric, shape ``(worlds, terms)``,
        named by ``columns``."""
        steps = self.sums[:, int(STEPS)].clamp(min=1.0)
        terms = self.sums[:, int(TERMS) :].clone()
        for column, name in enumerate(self.columns):
            if name.startswith("metric_") and name not in self.final:
                terms[:, column] /= steps
        return terms

    @property
    def meaning(self) -> str:
        """The criterion of success, in words."""
        if self.success is None:
            return BY_CLOCK if self.says_success else "the task does not say"
        metric = f"metric_{self.success}" in self.columns
        return f"{self.success} above 0 in the last step" if metric else f"{self.success} ended the episode"

    def successes(self, time_outs: torch.Tensor) -> torch.Tensor:
        """Whether each episode was a success, shape ``(worlds,)``, bool; false if its physics failed.

        Args:
            time_outs: Whether the clock, or a termination that counts as a time-out, ended it, shape ``(worlds,)``, bool.
        """
        return time_outs if self.success is None else self.judged & (self.causes != int(PHYSICS_FAILED))
