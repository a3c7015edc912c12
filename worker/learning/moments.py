"""The moments of observations over all ranks: their running mean and variance, sums of an iteration, and how these are merged."""

from __future__ import annotations

from typing import Any

import torch


def gather(observations: torch.Tensor, normalizer: Any, sums: torch.Tensor) -> None:
    """Sums and sums of squares of an iteration's observations, for the ranks to add up.

    Args:
        observations: Shape (steps, worlds, size), float32.
        normalizer: rsl-rl's ``EmpiricalNormalization``.
        sums: Filled; shape (2 * size,), float64.
    """
    size = observations.shape[-1]
    # around the running mean, which all ranks share: keeps the squares small
    offsets = (observations - normalizer._mean).flatten(0, 1)
    sums[:size] = offsets.sum(0, dtype=torch.float64)
    sums[size:] = offsets.square_().sum(0, dtype=torch.float64)


def merge(normalizer: Any, count: torch.Tensor, sums: torch.Tensor, learns: torch.Tensor | float = 1.0) -> None:
    """Merge an iteration's observations of all ranks into the running moments (Chan et al. 1979), as rsl-rl does.

    Args:
        normalizer: Changed in place.
        count: Number of observations, shape (), float64.
        sums: From :func:`gather`, summed over all ranks.
        learns: 1, or 0 to leave the running moments as they are, shape ().
    """
    size = len(sums) // 2
    offset = sums[:size] / count
    variance = (sums[size:] / count - offset.square()).clamp(min=0.0)
    normalizer.count.add_((learns * count).long())
    rate = learns * count / normalizer.count
    # with δ the batch mean less the running one: var += rate · (batch var − var + (1 − rate) · δ²)
    normalizer._var.add_(rate * (variance - normalizer._var + (1.0 - rate) * offset.square()))
    normalizer._mean.add_(rate * offset)
    normalizer._std.copy_(normalizer._var.sqrt())
