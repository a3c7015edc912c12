"""The state of the worlds at the start of an iteration, to repeat a failed iteration: ``worker.repeat_incident``."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from shared_store.volume.files import write_atomic
from worker.tasks.run.policy_contract import robots_of

if TYPE_CHECKING:
    from worker.learning.algorithm import WorldShare
    from worker.tasks.run.task import Task


class Incident:
    """Keeps the data for :meth:`write` on the device. Costs one copy of the worlds' state per iteration, in the rollout's own graph."""

    def __init__(self, task: Task, share: WorldShare, steps: int, section: dict[str, Any], seed: int) -> None:
        self._share, self._section, self._seed = share, section, seed
        self._live, self._robots = task.state_tensors(), robots_of(task)
        self._kept = {name: tensor.clone() for name, tensor in self._live.items()}
        self._actions = torch.zeros(steps, *task.actions.shape, device=task.device)
        self._began: tuple[int, float | None, float | None] = (0, None, None)
        self._others: Mapping[str, torch.Tensor] = {}

    def begin(
        self,
        iteration: int,
        reward: float | None,
        episode_length: float | None,
        others: Mapping[str, torch.Tensor],
    ) -> None:
        """Keep the arguments of the task's ``begin_iteration``, for its curriculum, and of its ``take_counts``."""
        self._began, self._others = (iteration, reward, episode_length), others

    def keep(self) -> None:
        """Keep the worlds' state before the first step."""
        torch._foreach_copy_(list(self._kept.values()), list(self._live.values()))

    def note(self, step: int, actions: torch.Tensor) -> None:
        """Keep the next actions, shape (worlds, actions)."""
        self._actions[step].copy_(actions)

    def write(self, path: Path, iteration: int) -> None:
        """Write the state at the beginning of the last iteration and all its actions."""
        share = self._share
        content = {
            "iteration": iteration,
            "directory": os.getcwd(),
            "began": list(self._began),
            "others": {name: counts.cpu() for name, counts in self._others.items()},
            "train": self._section,
            "seed": self._seed,
            "first_world": share.first,
            "worlds": share.count,
            "robots": [asdict(robot) for robot in self._robots],
            "state": {name: tensor.cpu() for name, tensor in self._kept.items()},
            "actions": self._actions.cpu(),
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomic(path, buffer.getvalue())
