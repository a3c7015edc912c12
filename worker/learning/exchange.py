"""The per-iteration exchange between the ranks, and its single transfer to the host."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from worker.learning.distributed import Gang
from worker.learning.parts import Totals

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

SIGNALS = ("stopping", "save_now", "failed_saves", "busy", "stall", "iteration_seconds", "long")
"""Per-rank flags summed over the ranks each iteration: stop requests, save requests, failed saves, ranks whose earlier saves the
volume does not take, save stall [s], iteration time [s], iterations that a stop may not be able to await."""


class Exchange:
    """Sums over the ranks: the task's statistics, its failed worlds and the :data:`SIGNALS`."""

    def __init__(self, gang: Gang, task: Task) -> None:
        self._gang, self._task = gang, task
        # of each rank: the seconds of its previous rollout, and its failed world (see Task.read_failed_world)
        of_ranks = {"collected": gang.size, "failed_world": gang.size}
        sizes = {**of_ranks, "statistics": len(task.statistic_names), "signals": len(SIGNALS)}
        self._totals = Totals(sizes, gang.device)
        self._own = torch.zeros(1 + len(SIGNALS), dtype=torch.float64, pin_memory=gang.device != "cpu")
        self._pinned: torch.Tensor | None = None

    def gather(self, collected: float, signals: Mapping[str, float]) -> None:
        """Sum the rollout's statistics and each rank's signals over the ranks; clears the task's statistics.

        Args:
            collected: Duration of this rank's previous rollout [s].
            signals: This rank's :data:`SIGNALS`.
        """
        totals, rank = self._totals, self._gang.rank
        totals.values.zero_()
        totals["failed_world"][rank].copy_(self._task.failed_world[0])
        totals["statistics"].copy_(self._task.statistics)
        self._task.clear_statistics()
        # the device has copied the previous iteration's values: read() waited for it
        self._own.copy_(torch.tensor([collected, *(float(signals[name]) for name in SIGNALS)], dtype=torch.float64))
        totals["collected"][rank : rank + 1].copy_(self._own[:1], non_blocking=True)
        totals["signals"].copy_(self._own[1:], non_blocking=True)
        self._gang.sum(totals.values)

    def read(self, metrics: Mapping[str, torch.Tensor]) -> tuple[dict[str, float], dict[str, list[float]]]:
        """``metrics`` and the totals by name, on the host: the one place where an iteration waits for the device.

        Args:
            metrics: Each of shape (), on the device.
        """
        numbers = torch.cat([torch.stack([value.double() for value in metrics.values()]), self._totals.values])
        if numbers.is_cuda:
            if self._pinned is None:
                self._pinned = torch.empty_like(numbers, device="cpu", pin_memory=True)
            self._pinned.copy_(numbers, non_blocking=True)
            arrived = torch.cuda.Event(blocking=True)  # let the waiting core sleep
            arrived.record()
            arrived.synchronize()
            numbers = self._pinned
        known = numbers.tolist()
        return dict(zip(metrics, known, strict=False)), self._totals.named(known[len(metrics) :])
