"""Terms written in torch: functions of the task that return a tensor with one row per world."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import warp as wp

from worker.tasks.compile.binding import Bound
from worker.tasks.compile.plan import KernelPlan

if TYPE_CHECKING:
    from worker.tasks.run.declared import DeclaredTask


class TorchTerms:
    """The torch terms of a task. The task's kernels read their results from columns, where they would call a Warp function.

    They run between the kernels, on the same stream, and nothing waits for the host: torch captures them with the training.
    Observation terms run twice per step: before and after the reset of worlds.

    Args:
        task: The task whose worlds they read.
        plan: The task's.
        external: Their results, shape ``(worlds, columns)``.

    Attributes:
        any: Whether there are any.
        observe_any: Whether any is an observation.
    """

    def __init__(self, task: DeclaredTask, plan: KernelPlan, external: wp.array2d[wp.float32]) -> None:
        self._task = task
        self._terms = list({bound.place: bound for bound in plan.terms if bound.signature is None}.values())
        self._seen = [bound for bound in self._terms if bound.place.startswith("observations")]
        self._columns: torch.Tensor | None = wp.to_torch(external) if self._terms else None
        self.any, self.observe_any = bool(self._terms), bool(self._seen)

    def judge(self) -> None:
        """Run all terms, after the physics."""
        for bound in self._terms:
            self._run(bound)

    def observe(self) -> None:
        """Run the observation terms again."""
        for bound in self._seen:
            self._run(bound)

    def _run(self, bound: Bound) -> None:
        parameters: dict[str, Any] = bound.term.parameters
        given = bound.term.function(self._task, **parameters)
        worlds = self._task.world_count
        fitting = [(worlds, bound.width)] + ([(worlds,)] if bound.width == 1 else [])
        if not isinstance(given, torch.Tensor) or tuple(given.shape) not in fitting:
            found = tuple(given.shape) if isinstance(given, torch.Tensor) else type(given).__name__
            raise ValueError(
                f"task {type(self._task).__name__}: {bound.place}: {bound.term.function_name} gives {found}; "
                f"expected a tensor of shape ({worlds}, {bound.width}), as size= says"
            )
        assert self._columns is not None
        self._columns[:, bound.external : bound.external + bound.width].copy_(given.reshape(worlds, bound.width))
