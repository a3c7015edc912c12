"""Asynchronous copies of a device's state in host memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

_ALIGNED = 16
"""Every tensor begins at a multiple of this [bytes], so that the device reads several numbers at a time."""


class HostCopies:
    """Copies of tensors in host memory, kept from one save to the next.

    A device first gathers its tensors into one buffer of its own memory, with a kernel for each dtype, and sends it to pinned memory in
    parallel with its further work. Sent one by one, in sequence with the work, a hundred small tensors took longer than the whole buffer.
    """

    def __init__(self) -> None:
        self._forms: list[tuple[torch.dtype, torch.Size]] = []
        """Of the tensors that the views below are for."""
        self._alike: list[list[int]] = []
        """Groups of tensors with the same dtype; one kernel copies each group."""
        self._gathered: list[torch.Tensor] = []
        self._received: list[torch.Tensor] = []
        self._piece, self._memory = torch.empty(0, dtype=torch.uint8), torch.empty(0, dtype=torch.uint8)
        """On the device, and pinned on the host; of the same size."""
        self._beside: torch.cuda.Stream | None = None

    def take(self, value: Any) -> Any:
        """``value`` with every tensor in it replaced by its copy; those of a device are complete after :meth:`wait`."""
        found: list[torch.Tensor] = []

        def find(tensor: torch.Tensor) -> torch.Tensor:
            if tensor.is_cuda:
                found.append(tensor.detach())
                return tensor
            return tensor.detach().clone()

        copied = _replaced(value, find)
        if not found:
            return copied
        received = iter(self._send(found))
        return _replaced(copied, lambda tensor: next(received) if tensor.is_cuda else tensor)

    def wait(self) -> None:
        """Wait until the copies are complete; any thread may call it."""
        if self._beside:
            self._beside.synchronize()

    def _send(self, tensors: list[torch.Tensor]) -> list[torch.Tensor]:
        if self._beside is None:
            self._beside = torch.cuda.Stream(tensors[0].device)
        here = torch.cuda.current_stream(tensors[0].device)
        here.wait_stream(self._beside)  # the buffer is overwritten
        forms = [(tensor.dtype, tensor.shape) for tensor in tensors]
        if forms != self._forms:
            self._lay_out(tensors)
            self._forms = forms
        for alike in self._alike:
            torch._foreach_copy_([self._gathered[index] for index in alike], [tensors[index] for index in alike])
        self._beside.wait_stream(here)
        with torch.cuda.stream(self._beside):
            self._memory.copy_(self._piece, non_blocking=True)
        return self._received

    def _lay_out(self, tensors: list[torch.Tensor]) -> None:
        """Make a view of the device's buffer and one of the host's memory for each tensor. Both grow when they are too small."""
        by_dtype: dict[torch.dtype, list[int]] = {}
        for index, tensor in enumerate(tensors):
            by_dtype.setdefault(tensor.dtype, []).append(index)
        self._alike = list(by_dtype.values())
        starts, size = [], 0
        for tensor in tensors:
            starts.append(size)
            size += -(-tensor.nbytes // _ALIGNED) * _ALIGNED
        if size > self._piece.nbytes:
            self.wait()  # for the previous copy, whose memory is freed
            self._piece = torch.empty(size, dtype=torch.uint8, device=tensors[0].device)
            self._memory = torch.empty(size, dtype=torch.uint8, pin_memory=True)
        places = list(zip(starts, tensors, strict=True))
        self._gathered = [
            self._piece[start : start + each.nbytes].view(each.dtype).view(each.shape) for start, each in places
        ]
        # each with a storage of its own: a file would otherwise hold the whole memory for any of them
        host = self._memory.numpy()
        self._received = [
            torch.frombuffer(host, dtype=each.dtype, count=each.numel(), offset=start).view(each.shape)
            if each.numel()
            else torch.empty(each.shape, dtype=each.dtype)
            for start, each in places
        ]


def _replaced(value: Any, change: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """``value`` with :func:`change` of every tensor in it, in order."""
    if isinstance(value, torch.Tensor):
        return change(value)
    if isinstance(value, dict):
        return {name: _replaced(item, change) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_replaced(item, change) for item in value)
    return value
