"""Observations beside those that a task gives: images as numbers, and made-up ones on which an exported policy is compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict
from torch import nn

SAMPLES, IMAGES = 1024, 16
"""How many are made up: numbers, or with images, for which ONNX's evaluator takes its time."""


def to_numbers(images: torch.Tensor) -> torch.Tensor:
    """Bytes from 0 to 255 as float32 from -0.5 to 0.5."""
    return images.to(torch.float32) / 255.0 - 0.5


def made_up(shapes: Mapping[str, Sequence[int]], normalizer: nn.Module | None) -> TensorDict:
    """Observations as a policy has met them, by its normaliser's moments, a few far outside; images of any bytes.

    Args:
        shapes: Of one observation of each group, in the order in which the policy sees them: one dimension, or three of an image.
        normalizer: Of all the groups of numbers, one behind the other; any other module than rsl_rl's is passed over.

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
