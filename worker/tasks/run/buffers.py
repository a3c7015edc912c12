"""The buffers of a task, each allocated once and shared by torch and Warp."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import warp as wp

from worker.simulation.episodes import WATCHED, EpisodeArrays

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


class Buffers:
    """One row per world of each field of :class:`EpisodeArrays`, as ``arrays`` for kernels and by name for torch.

    Args:
        task: The task, whose plan and worlds exist.
        causes: How many causes of failures there are.
    """

    def __init__(self, task: Task, causes: int) -> None:
        self.arrays = arrays = EpisodeArrays()
        worlds, weights = task.worlds.arrays, list(task.plan.weights.values())
        arrays.warm_start, arrays.activations = worlds.warm_start, worlds.activations
        arrays.failure_causes = causes
        count, terms, observations = task.world_count, len(weights), len(task.observation_names)
        actions, sums = 1 if task.discrete else task.action_size, 2 + terms + len(task.metric_names)
        for name, shape, dtype in (
            ("actions", (count, actions), wp.float32),
            ("observations", (count, observations), wp.float32),
            ("terminal_observations", (count, observations), wp.float32),
            ("rewards", (count,), wp.float32),
            ("dones", (count,), wp.bool),
            ("time_outs", (count,), wp.bool),
            ("ages", (count,), wp.int32),
            ("sums", (count, sums), wp.float32),
            ("random", (count, 3), wp.int32),
            ("terms", (min(WATCHED, count), terms), wp.float32),
            ("memory", (count, task.plan.binder.memory), wp.float32),
            ("lasting", (count, task.plan.binder.lasting), wp.float32),
            ("last_actions", (count, actions), wp.float32),
            ("earlier_actions", (count, actions), wp.float32),
            ("broken", (count,), wp.int32),
            ("failed_world", (1,), wp.int32),
            ("weights", (terms,), wp.float32),
            ("level", (1,), wp.float32),
            ("statistics", (len(task.statistic_names),), wp.float64),
            ("last_sums", (count, sums), wp.float32),
            ("causes", (count,), wp.int32),
            ("successes", (count,), wp.bool),
        ):
            setattr(arrays, name, wp.zeros(shape, dtype=dtype, device=task.device))
        self["weights"].copy_(torch.tensor(weights))
        self["level"].fill_(1.0)

    def __getitem__(self, name: str) -> torch.Tensor:
        """A field as a live tensor."""
        shared: torch.Tensor = wp.to_torch(getattr(self.arrays, name))
        return shared
