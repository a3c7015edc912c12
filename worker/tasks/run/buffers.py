"""The buffers of a task, each allocated once and shared by torch and Warp."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import warp as wp

from worker.simulation.episodes import WATCHED, EpisodeArrays
from worker.simulation.worlds import Worlds


class Buffers:
    """One row per world of each field of :class:`EpisodeArrays`.

    Args:
        worlds: The worlds.
        actions: Numbers of an action.
        observations: Columns of the policy's observations.
        weights: Of the reward terms.
        metrics: How many metrics there are.
        memory: Numbers in ``episodes.memory``.
        lasting: Numbers in ``episodes.lasting``.
        statistics: How many statistics there are.
        causes: How many causes of mishaps there are.

    Attributes:
        arrays: As kernels see them.
    """

    def __init__(
        self,
        worlds: Worlds,
        *,
        actions: int,
        observations: int,
        weights: Sequence[float],
        metrics: int,
        memory: int,
        lasting: int,
        statistics: int,
        causes: int,
    ) -> None:
        self.arrays = arrays = EpisodeArrays()
        arrays.warm_start, arrays.activations = worlds.arrays.warm_start, worlds.arrays.activations
        arrays.causes_of_mishaps = causes
        count, terms = worlds.world_count, len(weights)
        for name, shape, dtype in (
            ("actions", (count, actions), wp.float32),
            ("observations", (count, observations), wp.float32),
            ("terminal_observations", (count, observations), wp.float32),
            ("rewards", (count,), wp.float32),
            ("dones", (count,), wp.bool),
            ("time_outs", (count,), wp.bool),
            ("ages", (count,), wp.int32),
            ("sums", (count, 2 + terms + metrics), wp.float32),
            ("random", (count, 3), wp.int32),
            ("terms", (min(WATCHED, count), terms), wp.float32),
            ("memory", (count, memory), wp.float32),
            ("lasting", (count, lasting), wp.float32),
            ("last_actions", (count, actions), wp.float32),
            ("earlier_actions", (count, actions), wp.float32),
            ("broken", (count,), wp.int32),
            ("mishap", (1,), wp.int32),
            ("weights", (terms,), wp.float32),
            ("level", (1,), wp.float32),
            ("statistics", (statistics,), wp.float64),
            ("last_sums", (count, 2 + terms + metrics), wp.float32),
            ("causes", (count,), wp.int32),
            ("successes", (count,), wp.bool),
        ):
            setattr(arrays, name, wp.zeros(shape, dtype=dtype, device=worlds.model.device))
        self["weights"].copy_(torch.tensor(list(weights)))
        self["level"].fill_(1.0)

    def __getitem__(self, name: str) -> torch.Tensor:
        """A field as a live tensor."""
        shared: torch.Tensor = wp.to_torch(getattr(self.arrays, name))
        return shared
