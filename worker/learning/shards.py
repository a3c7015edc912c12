"""Read a checkpoint without running code from it, and its worlds by global index, whatever their shards."""

from __future__ import annotations

import pickle
import re
from typing import Any

import torch

from shared_store.volume.checkpoints import Checkpoint
from worker.settings.errors import UserError


def read_file(checkpoint: Checkpoint, name: str, device: str = "cpu") -> dict[str, Any]:
    """The content of one file of ``checkpoint``: dictionaries and lists of tensors and plain values.

    Raises UserError for any other content, which is neither imported nor run (``weights_only=True``).
    """
    where = f"checkpoint {checkpoint.name}: {name}"
    try:
        content = torch.load(checkpoint.path / name, map_location=device, weights_only=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL ([\w.]+)", str(error))
        what = f"asks for {found[1]}" if found else "is not plain data"
        raise UserError(
            f"{where} {what}: only tensors and plain values are loaded, and nothing of it was run; choose a checkpoint "
            "that you trust"
        ) from error
    except Exception as error:  # torch's reader can raise anything on a file that is not a checkpoint
        lines = str(error).splitlines() or [type(error).__name__]
        raise UserError(f"{where} can't be loaded: {lines[0]}") from error
    if not isinstance(content, dict):
        raise UserError(f"{where} holds a {type(content).__name__}, not the state of a training")
    return content


class Shards:
    """The files ``rank-<k>.pt`` of one checkpoint, each read once, on first use."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        self.bounds: list[list[int]] = checkpoint.manifest["shards"]
        """Global index of the first world, and number of worlds, of each rank."""
        self._read: dict[int, dict[str, Any]] = {}

    def rank(self, rank: int) -> dict[str, Any]:
        """The saved ``worlds`` and ``generators`` of rank ``rank``. Raises UserError, as :func:`read_file`."""
        if rank not in self._read:
            self._read[rank] = read_file(self.checkpoint, f"rank-{rank}.pt")
        return self._read[rank]

    def worlds(self, first: int, count: int) -> dict[str, torch.Tensor]:
        """Every tensor of the worlds ``[first, first + count)``, on the CPU, each with leading dimension ``count``."""
        last = first + count
        pieces: list[dict[str, torch.Tensor]] = []
        for rank, (begin, size) in enumerate(self.bounds):
            low, high = max(first, begin), min(last, begin + size)
            if low < high:
                state = self.rank(rank)["worlds"]["state"]
                pieces.append({name: tensor[low - begin : high - begin] for name, tensor in state.items()})
        return {name: torch.cat([piece[name] for piece in pieces]) for name in pieces[0]}
