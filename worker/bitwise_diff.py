"""``python -P -m worker.bitwise_diff RUN_A RUN_B``: whether two runs ended with the same bits.

A run is the name of one in ``$MUSTER_STORE``, or its directory. Compared are the newest checkpoints (every tensor and value of
``learner.pt``, every world by its global index, the ranks' generators where there are equally many, what the manifest says of the
training) and the metrics, iteration by iteration; left out is only what says how long something took, or when.
Prints ``equal: 23 tensors, 20 iterations`` and exits 0, or the first difference and exits 1.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from shared_store.contract.error_text import counted
from shared_store.volume.checkpoints import Checkpoint, list_checkpoints
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import read_metrics
from worker.learning.job import EX_ERROR, EX_USAGE, run_command
from worker.learning.shards import Shards, read_file
from worker.settings.errors import UserError

_CIRCUMSTANCES = {"created", "epoch", "files", "format", "seconds", "shards", "train", "world_size"}
"""Keys of a manifest on how and when it was written, not on what was learnt (``train`` holds the job's settings)."""
_BITS = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


class Difference(Exception):
    """The first difference: file, key, index, both values."""


def compare(first: Run, second: Run) -> str:
    """A description of the equal parts. Raises Difference where any part differs, UserError where a run has nothing to compare."""
    one, two = _newest(first), _newest(second)
    if one.iteration != two.iteration:
        raise Difference(f"checkpoints: {one.name} of {first.name}, {two.name} of {second.name}: other iterations")
    tensors = _compare_files(one, two)
    _compare_metrics(first, second, one.iteration)
    return f"{counted(tensors, 'tensor')}, {counted(one.iteration, 'iteration')}"


def _newest(run: Run) -> Checkpoint:
    checkpoints = list_checkpoints(run)
    if not checkpoints:
        raise UserError(f"run {run.name} has no checkpoint in {run.checkpoints}; train it first")
    checkpoints[-1].verify()
    return checkpoints[-1]


def _compare_files(one: Checkpoint, two: Checkpoint) -> int:
    """Compare all that two checkpoints hold; returns how many tensors that is."""
    tensors = _compare_values("learner.pt", read_file(one, "learner.pt"), read_file(two, "learner.pt"))
    totals = [checkpoint.manifest["worlds"] for checkpoint in (one, two)]
    if totals[0] != totals[1]:
        raise Difference(f"manifest.json: worlds: {totals[0]} and {totals[1]}")
    shards = [Shards(checkpoint) for checkpoint in (one, two)]
    tensors += _compare_values("worlds", *(each.worlds(0, totals[0]) for each in shards))
    ranks = [len(each.bounds) for each in shards]
    if ranks[0] == ranks[1]:
        for rank in range(ranks[0]):
            tensors += _compare_values(f"rank-{rank}.pt", *(each.rank(rank)["generators"] for each in shards))
    else:
        print(
            f"generators are not compared: {counted(ranks[0], 'rank')} saved them in one run, {ranks[1]} in the other"
        )
    facts = [{k: v for k, v in each.manifest.items() if k not in _CIRCUMSTANCES} for each in (one, two)]
    _compare_values("manifest.json", *facts)
    return tensors


def _compare_values(file: str, one: Any, two: Any) -> int:
    """Compare two nested values bit by bit; returns how many tensors they hold. Raises Difference."""
    first, second = (dict(_flatten(value)) for value in (one, two))
    for key in first.keys() ^ second.keys():
        raise Difference(f"{file}: {key}: only one of the two has it")
    for key, value in first.items():
        other = second[key]
        if isinstance(value, torch.Tensor) and isinstance(other, torch.Tensor):
            _compare_tensors(f"{file}: {key}", value, other)
        elif type(value) is not type(other) or repr(value) != repr(other):  # repr tells -0.0 from 0.0, and nan is nan
            raise Difference(f"{file}: {key}: {value!r} and {other!r}")
    return sum(isinstance(value, torch.Tensor) for value in first.values())


def _flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Everything in nested dictionaries and lists, by path; an empty one counts as a value."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from _flatten(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple) and value:
        for index, item in enumerate(value):
            yield from _flatten(item, f"{path}.{index}" if path else str(index))
    else:
        yield path, value


def _compare_tensors(where: str, one: torch.Tensor, two: torch.Tensor) -> None:
    if one.shape != two.shape or one.dtype != two.dtype:
        raise Difference(f"{where}: {one.dtype} {list(one.shape)} and {two.dtype} {list(two.shape)}")
    bits = [tensor.contiguous().reshape(-1).view(_BITS[tensor.element_size()]) for tensor in (one, two)]
    unequal = (bits[0] != bits[1]).nonzero()
    if len(unequal):
        place = int(unequal[0])
        index = [int(i) for i in torch.unravel_index(torch.tensor(place), one.shape)] if one.dim() else []
        values = " and ".join(repr(tensor.reshape(-1)[place].item()) for tensor in (one, two))
        raise Difference(f"{where}: at {index}: {values} ({len(unequal)} of {one.numel()} elements differ)")


def _compare_metrics(first: Run, second: Run, iterations: int) -> None:
    """Compare the metrics of iterations 1 to ``iterations``. Raises Difference."""
    for run in (first, second):
        found = [record["iteration"] for record in read_metrics(run)]
        if found != list(range(1, iterations + 1)):
            lacking = next((i for i in range(1, iterations + 1) if i not in found), found[-1] if found else 1)
            raise Difference(f"metrics: run {run.name} has {len(found)} of {iterations} iterations (look at {lacking})")
    for one, two in zip(read_metrics(first), read_metrics(second), strict=True):
        _compare_values(f"metrics of iteration {one['iteration']}", _timeless(one), _timeless(two))


def _timeless(record: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value
        for key, value in record.items()
        if not key.endswith("_seconds") and key not in ("steps_per_second", "time", "slowest_rank", "slowest_excess")
    }


def find_run(name: str) -> Run:
    """The run called ``name`` in ``$MUSTER_STORE``, or the one in directory ``name``. Raises UserError, StoreError."""
    store = os.environ.get("MUSTER_STORE")
    if os.sep not in name and not store:
        raise UserError(f"run {name}: set MUSTER_STORE to the store that has it, or give the run's directory")
    run = Run(Path(name).absolute()) if os.sep in name else Store(store or "").run(name)
    if run.description() is None and not run.checkpoints.is_dir():
        raise UserError(f"run {name} does not exist: there is no {run.path}")
    return run


def main() -> int:
    """Compare; returns the exit code: 0 equal, 1 different, 2 wrong use."""
    if len(sys.argv) != 3:
        print("usage: python -P -m worker.bitwise_diff RUN_A RUN_B", file=sys.stderr)
        return EX_USAGE
    first, second = (find_run(name) for name in sys.argv[1:])
    try:
        print(f"equal: {compare(first, second)}")
    except Difference as difference:
        print(f"different: {difference}")
        return EX_ERROR
    return 0


if __name__ == "__main__":
    run_command(main)
