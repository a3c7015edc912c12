"""Numbers that adapt to the policy's performance, and their part of a run's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import torch

from worker.tasks.declare.declaration import Adaptive

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


class Adapting:
    """The adaptive numbers of a task.

    Args:
        rules: By name.
        number: A live view of the numbers of a place.
        world_count: Of this rank.
        device: Of the state.

    Attributes:
        state: The same row for every world, so that worlds can be resharded: the last iteration that has begun, then the step of
            each rule; float32, shape ``(worlds, 1 + rules)``.
    """

    def __init__(
        self, rules: Mapping[str, Adaptive], number: Callable[[str], torch.Tensor], world_count: int, device: str
    ) -> None:
        self._names, self._rules, self._number = list(rules), list(rules.values()), number
        self.state = torch.zeros(world_count, 1 + len(rules), device=device)
        self.state[:, 0] = -1.0
        self.read()

    def read(self) -> None:
        """Take the steps from :attr:`state`, at the start and after a load, and set the numbers."""
        started, *steps = self.state[0].tolist()
        self._last_iteration, self._steps = int(started), steps
        self._write()

    @property
    def steps(self) -> dict[str, float]:
        """The step of each rule, by name."""
        return dict(zip(self._names, self._steps, strict=True))

    def hold(self, iteration: int, steps: Mapping[str, float]) -> None:
        """Set the numbers of a checkpoint and hold them through ``iteration``; :meth:`begin` moves them only after it.

        Args:
            iteration: The checkpoint's last.
            steps: As :attr:`steps`; a rule that it lacks is at its start.
        """
        self._last_iteration = max(self._last_iteration, iteration)
        rules = zip(self._names, self._rules, strict=True)
        self._steps = [min(max(float(steps.get(name, 0.0)), 0.0), float(rule.steps)) for name, rule in rules]
        self._write()

    def begin(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        """Move each number forward or back, once per iteration, before it begins.

        Args:
            iteration: Number of finished iterations.
            reward: Mean return of the episodes that ended last; None before the first.
            episode_length: Their mean length [steps].
        """
        if iteration <= self._last_iteration or not self._rules:
            return
        self._last_iteration = iteration
        pairs = zip(self._rules, self._steps, strict=True)
        self._steps = [rule.after(step, reward, episode_length) for rule, step in pairs]
        self._write()

    def _write(self) -> None:
        for rule, step in zip(self._rules, self._steps, strict=True):
            self._number(rule.place).fill_(rule.value(step))
        self.state[:] = torch.tensor([float(self._last_iteration), *self._steps])


def adaptive_steps(task: Task) -> dict[str, float]:
    """The step of each adaptive number of a task, by name, as in a checkpoint's manifest."""
    return task.adapting.steps if task.adapting else {}


def begin_evaluation(
    task: Task, iteration: int, reward: float | None, episode_length: float | None, steps: Mapping[str, float]
) -> None:
    """As :meth:`Task.begin_iteration`, for an evaluation: adaptive numbers are as in the training, and do not move.

    Args:
        task: The worlds of the evaluation; they may be those of the training.
        iteration: The training's last, as are the next two.
        reward: Mean return of the episodes that ended last; None before the first.
        episode_length: Their mean length [steps].
        steps: From :func:`adaptive_steps` in the training; a number that it lacks is at its start.
    """
    if task.adapting:
        task.adapting.hold(iteration, steps)
    task.begin_iteration(iteration, reward, episode_length)
