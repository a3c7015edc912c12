"""A multi-layer perceptron whose bias gradients cost next to nothing on a GPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


class _Linear(torch.autograd.Function):
    """``x @ weight.T + bias``. torch sums a bias's gradient over the samples with a general reduction, which takes longer than the
    layer's own products; as a matrix-vector product with ones it is bound by memory alone."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(x, weight)
        return torch.addmm(bias, x, weight.t())

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        ones = gradient.new_ones(len(gradient))
        return (
            gradient @ weight if ctx.needs_input_grad[0] else None,
            gradient.t() @ x,
            torch.mv(gradient.t(), ones),
        )


def forward(mlp: nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    """What ``mlp(x)`` is, shape (samples, outputs), for ``x`` of shape (samples, inputs)."""
    if not x.is_cuda:
        return mlp(x)
    for layer in mlp:
        x = _Linear.apply(x, layer.weight, layer.bias) if isinstance(layer, nn.Linear) else layer(x)
    return x
