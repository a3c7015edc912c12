"""Numbers that follow how well the policy does, and what of them is part of a run's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch

from worker.tasks.declaration import Adaptive


class Adapting:
    """The adaptive numbers of a task.

    Args:
        rules: By name.
        number: A live view of the numbers of a place.
        world_count: Of this rank.
        device: Of the state.

    Attributes:
        state: The same row for every world, so that worlds can be dealt out again: the last iteration that was begun, then the step of
            each rule; float32, shape ``(worlds, 1 + rules)``.
    """

    def __init__(
        self, rules: Mapping[str, Adaptive], number: Callable[[str], torch.Tensor], world_count: int, device: str
    ) -> None:
        self._rules, self._number = list(rules.values()), number
        self.state = torch.zeros(world_count, 1 + len(rules), device=device)
        self.state[:, 0] = -1.0
        self.read()

    def read(self) -> None:
        """Take the steps from :attr:`state`, at the beginning and after it was loaded, and set the numbers."""
        begun, *steps = self.state[0].tolist()
        self._begun, self._steps = int(begun), steps
        self._write()

    def begin(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        """Before an iteration: go on or back. Once an iteration: an evaluation begins its last one again.

        Args:
            iteration: How many are done.
            reward: Mean return of the episodes that ended last; None before the first.
            episode_length: Their mean length [steps].
        """
        if iteration <= self._begun or not self._rules:
            return
        self._begun = iteration
        pairs = zip(self._rules, self._steps, strict=True)
        self._steps = [rule.after(step, reward, episode_length) for rule, step in pairs]
        self._write()

    def _write(self) -> None:
        for rule, step in zip(self._rules, self._steps, strict=True):
            self._number(rule.place).fill_(rule.value(step))
        self.state[:] = torch.tensor([float(self._begun), *self._steps])
