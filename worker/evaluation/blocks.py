"""Blocks of worlds: a policy is asked about a fixed number of worlds at a time, whatever number there are.

The products of a network round otherwise for another number of rows. In blocks of one size, in which an episode always has the same row,
an action is a function of the observation and the row alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from worker.learning.algorithm import Policy

if TYPE_CHECKING:
    from tensordict import TensorDict

SIZE = 32
"""Worlds of a block."""


class Blocks:
    """One policy for each block of worlds, together acting for all of them.

    Args:
        policies: Of each block, alike; they may remember their episodes. There are ``size`` worlds for each.
        size: Worlds of a block.
    """

    def __init__(self, policies: Sequence[Policy], size: int = SIZE) -> None:
        self._policies, self._size = policies, size

    def act(self, observations: TensorDict) -> torch.Tensor:
        """Mean actions, shape ``(worlds, actions)``."""
        parts: Any = observations.split(self._size)
        return torch.cat([policy.act(part) for policy, part in zip(self._policies, parts, strict=True)])

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Forget the running episodes of all worlds, or where ``worlds`` is true."""
        parts = [None] * len(self._policies) if worlds is None else worlds.split(self._size)
        for policy, part in zip(self._policies, parts, strict=True):
            policy.reset(part)
