"""Terms written in torch: functions of the task that return a tensor with one row per world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import warp as wp

from worker.tasks.compile import external
from worker.tasks.compile.binding import Bound
from worker.tasks.compile.external import ExternalArrays
from worker.tasks.compile.plan import KernelPlan
from worker.tasks.declare.declaration import Metric, Reward, Termination

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


def external_arrays(plan: KernelPlan, count: int, device: str) -> ExternalArrays:
    """The table by which the kernels of ``count`` worlds read the results of torch terms."""
    arrays, rows = ExternalArrays(), list[tuple[int, int, int, int]]()
    for kind, section in enumerate(("rewards", "metrics", "terminations")):
        bounds: list[Bound] = getattr(plan, section)
        numbers = [number for number, bound in enumerate(bounds) if bound.signature is not None]
        setattr(arrays, ("rewards", "metrics", "ends")[kind], wp.array(numbers, dtype=wp.int32, device=device))
        rows += [
            (kind, bound.external, number, _options(bound))
            for number, bound in enumerate(bounds)
            if bound.signature is None
        ]
    arrays.judged = wp.array(rows, dtype=wp.int32, device=device) if rows else wp.zeros((0, 4), wp.int32, device=device)
    arrays.values = wp.zeros((count, plan.external), dtype=wp.float32, device=device)
    arrays.success = plan.external_success
    return arrays


def _options(bound: Bound) -> int:
    match bound.term:
        case Reward(per_second=rate, unless_terminated=alive):
            return external.PER_SECOND * rate + external.UNLESS_TERMINATED * alive
        case Metric(at_end=at_end):
            return external.AT_END * at_end
        case Termination(time_out=time_out):
            return external.TIME_OUT * time_out
    return 0


class TorchTerms:
    """The torch terms of a task. The task's kernels read their results from columns, where they would call a Warp function.

    They run between the kernels, on the same stream, and nothing waits for the host: torch captures them with the training.
    Observation terms run twice per step: before and after the reset of worlds.

    Args:
        task: The task whose worlds they read.
        plan: The task's.
        arrays: Where their results go.

    Attributes:
        any: Whether there are any.
        observe_any: Whether any is an observation.
    """

    def __init__(self, task: Task, plan: KernelPlan, arrays: ExternalArrays) -> None:
        self._task = task
        chosen = {
            bound.place: {
                name: torch.tensor(indices, dtype=torch.long, device=task.device)
                for name, indices in bound.chosen.items()
            }
            for bound in plan.in_torch
        }
        self._terms = [(bound, {**bound.term.parameters, **chosen[bound.place]}) for bound in plan.in_torch]
        self._seen = [each for each in self._terms if each[0].place.startswith("observations")]
        self._columns: torch.Tensor | None = wp.to_torch(arrays.values) if self._terms else None
        self.any, self.observe_any = bool(self._terms), bool(self._seen)

    def judge(self) -> None:
        """Run all terms, after the physics."""
        for bound, parameters in self._terms:
            self._run(bound, parameters)

    def observe(self) -> None:
        """Run the observation terms again."""
        for bound, parameters in self._seen:
            self._run(bound, parameters)

    def _run(self, bound: Bound, parameters: dict[str, object]) -> None:
        found = bound.term.function(self._task, **parameters)
        worlds = self._task.world_count
        fitting = [(worlds, bound.width)] + ([(worlds,)] if bound.width == 1 else [])
        if not isinstance(found, torch.Tensor) or tuple(found.shape) not in fitting:
            what = f"shape {tuple(found.shape)}" if isinstance(found, torch.Tensor) else type(found).__name__
            observed = bound.place.startswith("observations")
            remedy = (
                "set size= to its columns" if observed else "reduce each world's numbers to one, such as by .sum(-1)"
            )
            raise ValueError(
                f"task {type(self._task).__name__}: {bound.place}: {bound.term.function_name} gives {what}; expected a tensor "
                f"of shape {' or '.join(map(str, reversed(fitting)))} for {worlds} worlds: {remedy}"
            )
        assert self._columns is not None
        self._columns[:, bound.external : bound.external + bound.width].copy_(found.reshape(worlds, bound.width))
