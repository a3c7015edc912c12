"""Observations: images as numbers, the running moments over all ranks, and synthetic ones to compare an exported policy on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict
from torch import nn

SAMPLES, IMAGES = 1024, 16
"""Number of synthetic observations: of numbers, or with images, for which ONNX's evaluator takes its time."""


def to_numbers(images: torch.Tensor) -> torch.Tensor:
    """Bytes from 0 to 255 as float32 from -0.5 to 0.5."""
    return images.to(torch.float32) / 255.0 - 0.5


def gather_moments(observations: torch.Tensor, normalizer: Any, sums: torch.Tensor) -> None:
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


def merge_moments(normalizer: Any, count: torch.Tensor, sums: torch.Tensor, learns: torch.Tensor | float = 1.0) -> None:
    """Merge an iteration's observations of all ranks into the running moments (Chan et al. 1979), as rsl-rl does.

    Args:
        normalizer: Changed in place.
        count: Number of observations, shape (), float64.
        sums: From :func:`gather_moments`, summed over all ranks.
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


def synthetic(shapes: Mapping[str, Sequence[int]], normalizer: nn.Module | None) -> TensorDict:
    """Synthetic observations: drawn from the normaliser's moments, a few far outside; random bytes for images.

    Args:
        shapes: Of one observation of each group, in the policy's order: one dimension, or three for an image.
        normalizer: Of the concatenated groups of numbers; modules other than rsl_rl's are ignored.

    Returns:
        The same in each call, batch size (:data:`SAMPLES` or :data:`IMAGES`,), on the CPU.
    """
    generator = torch.Generator().manual_seed(0)
    sizes = [shape[0] for shape in shapes.values() if len(shape) == 1]
    count = SAMPLES if len(sizes) == len(shapes) else IMAGES
    numbers = torch.randn(count, sum(sizes), generator=generator)
    numbers[-count // 8 :] *= 5.0
    if isinstance(normalizer, EmpiricalNormalization):
        numbers = numbers * (normalizer.std.cpu() + normalizer.eps) + normalizer.mean.cpu()
    parts = iter(numbers.split(sizes, dim=1) if sizes else ())
    groups = {
        group: next(parts)
        if len(shape) == 1
        else torch.randint(0, 256, (count, *shape), dtype=torch.uint8, generator=generator)
        for group, shape in shapes.items()
    }
    return TensorDict(groups, batch_size=[count])
