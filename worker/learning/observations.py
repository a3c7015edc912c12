"""Helpers for observations: images as numbers, and synthetic observations to compare an exported policy on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict
from torch import nn

SAMPLES, IMAGES = 1024, 16
"""Number of made-up observations: of numbers, or with images, for which ONNX's evaluator takes its time."""


def to_numbers(images: torch.Tensor) -> torch.Tensor:
    """Bytes from 0 to 255 as float32 from -0.5 to 0.5."""
    return images.to(torch.float32) / 255.0 - 0.5


def made_up(shapes: Mapping[str, Sequence[int]], normalizer: nn.Module | None) -> TensorDict:
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
