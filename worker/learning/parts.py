"""Parts that the algorithms share: named sums over the ranks, kernels on torch's stream, gradients in one buffer, an optimizer's state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
import warp as wp

from worker.simulation.capture import on_torch_stream


class Totals:
    """A float64 vector with named parts, to be summed over the ranks.

    >>> totals = Totals({"episodes": 1, "seconds": 3}, "cpu")
    >>> totals["seconds"][1] = 0.5
    >>> totals.named(totals.values.tolist())["seconds"]
    [0.0, 0.5, 0.0]
    """

    def __init__(self, sizes: Mapping[str, int], device: str) -> None:
        self.values = torch.zeros(sum(sizes.values()), dtype=torch.float64, device=device)
        """All parts, one after the other, shape (n,)."""
        parts: Iterable[torch.Tensor] = self.values.split(list(sizes.values()))
        self._parts = dict(zip(sizes, parts, strict=True))

    def __getitem__(self, name: str) -> torch.Tensor:
        """A live view of one part, shape (its size,)."""
        return self._parts[name]

    def named(self, numbers: list[float]) -> dict[str, list[float]]:
        """Numbers in the order of :attr:`values`, by the names of the parts."""
        rest = iter(numbers)
        return {name: [next(rest) for _ in range(len(part))] for name, part in self._parts.items()}


def launch(kernel: wp.Kernel, dim: int | Sequence[int], arguments: Iterable[Any], device: str) -> None:
    """Launch a kernel on torch's current stream; it reads and writes the memory of the tensors among its ``arguments``."""
    inputs = [
        wp.from_torch(each.detach(), return_ctype=True) if isinstance(each, torch.Tensor) else each
        for each in arguments
    ]
    with on_torch_stream(device):
        wp.launch(kernel, dim=dim, inputs=inputs, device=device)


def keep_gradients(parameters: Iterable[torch.Tensor], buffer: torch.Tensor, aligned: int = 1) -> None:
    """Make the parameters' gradients views of ``buffer``, shape (n,); each begins at a multiple of ``aligned``."""
    offset = 0
    for parameter in parameters:
        parameter.grad = buffer[offset : offset + parameter.numel()].view_as(parameter)
        offset += -(-parameter.numel() // aligned) * aligned


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Load the moments of a saved ``state``, and keep this optimizer's own settings.

    Rates and decays are this job's. The rate may be a tensor that a graph reads; ``capturable`` depends on the device: in the state of a
    run that began on a CPU it is false, and no GPU could capture such a step.

    Raises ValueError if the state belongs to other parameters.
    """
    own = [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
    optimizer.load_state_dict(dict(state))
    for group, settings in zip(optimizer.param_groups, own, strict=True):
        group.update(settings)
