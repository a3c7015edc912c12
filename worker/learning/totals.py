"""Totals over the ranks: named numbers in one buffer, to be summed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch


class Totals:
    """A float64 vector with named parts.

    >>> totals = Totals({"episodes": 1, "seconds": 3}, "cpu")
    >>> totals["seconds"][1] = 0.5
    >>> Totals.named(totals.layout, totals.values.tolist())["seconds"]
    [0.0, 0.5, 0.0]
    """

    def __init__(self, sizes: Mapping[str, int], device: str, *, pinned: bool = False) -> None:
        """``pinned``: in pinned host memory, which a GPU copies without a wait of the host."""
        self.layout = dict(sizes)
        self.values = torch.zeros(sum(sizes.values()), dtype=torch.float64, device=device, pin_memory=pinned)
        """All parts, one after the other, shape (n,)."""
        parts: Iterable[torch.Tensor] = self.values.split(list(sizes.values()))
        self._parts = dict(zip(sizes, parts, strict=True))

    def __getitem__(self, name: str) -> torch.Tensor:
        """A live view of one part, shape (its size,)."""
        return self._parts[name]

    @staticmethod
    def named(layout: Mapping[str, int], numbers: list[float]) -> dict[str, list[float]]:
        """Numbers in the order of ``layout``, by name."""
        found, start = {}, 0
        for name, size in layout.items():
            found[name], start = numbers[start : start + size], start + size
        return found
