"""Linear layers of a multi-layer perceptron: matrix products aligned for tensor cores, and gradients written in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.nn import functional

ALIGNED = 8
"""Columns of a padded input are a multiple of this: products over 35 columns take 1.5 times as long as over 40."""


def padded(columns: int, device: str) -> int:
    """Padded number of columns of a buffer of ``columns``: on a GPU the next multiple of :data:`ALIGNED`."""
    return aligned(columns) if device.startswith("cuda") else columns


def aligned(count: int) -> int:
    """The next multiple of :data:`ALIGNED`."""
    return -(-count // ALIGNED) * ALIGNED


class _Linear(torch.autograd.Function):
    """``x @ weight.T + bias``, with zeros in the columns of ``x`` beyond those of ``weight``.

    The backward pass overwrites ``weight.grad`` and ``bias.grad``, which must exist, instead of adding to them: a minibatch has one such
    pass. torch would sum a bias's gradient over the samples with a general reduction, which takes longer than the layer's own products; a
    matrix-vector product with ones is bound only by memory.
    """

    @staticmethod
    def forward(
        ctx: Any, x: torch.Tensor, weight: nn.Parameter, bias: nn.Parameter, ones: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(x, weight)
        ctx.layer = weight, bias, ones
        return torch.addmm(bias, x, _as_wide(weight, x).t())

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, _ = ctx.saved_tensors
        weight, bias, ones = ctx.layer
        if x.shape[1] == weight.shape[1]:
            torch.mm(gradient.t(), x, out=weight.grad)
        else:
            weight.grad.copy_((gradient.t() @ x)[:, : weight.shape[1]])
        torch.mv(gradient.t(), ones, out=bias.grad)
        return gradient @ weight if ctx.needs_input_grad[0] else None, None, None, None


_linear: Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor] = _Linear.apply


def forward(mlp: nn.Sequential, x: torch.Tensor, ones: torch.Tensor | None = None) -> torch.Tensor:
    """The output of ``mlp`` for ``x``, shape (…, outputs).

    Args:
        mlp: Linear layers and activations.
        x: Shape (…, inputs or more); further columns must be zeros.
        ones: Shape (samples,), required on a GPU for gradients of an ``x`` of shape (samples, …).
    """
    if not x.is_cuda:
        outputs: torch.Tensor = mlp(x)
        return outputs
    for layer in mlp:
        if not isinstance(layer, nn.Linear):
            x = layer(x)
        elif ones is None:
            x = functional.linear(x, _as_wide(layer.weight, x), layer.bias)
        else:
            x = _linear(x, layer.weight, layer.bias, ones)
    return x


def _as_wide(weight: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    missing = x.shape[-1] - weight.shape[1]
    return functional.pad(weight, (0, missing)) if missing else weight
