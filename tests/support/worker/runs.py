"""Trainings, of :class:`tests.support.worker.point_task.Point` unless a test names another task, in the test's own process, and the bits that they end with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import raise_epoch, read_epoch
from shared_store.volume.layout import Store
from tests.support.worker.loop import alone
from tests.support.worker.point_task import TASK
from worker.learning.distributed import Gang
from worker.learning.job import Job, StopRequest
from worker.learning.loop import Loop
from worker.learning.training import Training
from worker.train import hooks


def runner(env: dict[str, str], gang: Gang | None = None, stop: StopRequest | None = None, task: Any = TASK) -> Loop:
    """One attempt, to which the run is given first, as a controller does."""
    job = Job.from_env(env, "train")
    if (gang is None or gang.is_main) and read_epoch(job.run) < job.epoch:
        raise_epoch(job.run, job.epoch)
    return Loop(Training.of(job, task), gang or alone(), stop or StopRequest(), hooks())


def train(env: dict[str, str], gang: Gang | None = None, task: Any = TASK) -> Loop:
    """Train to the end, as one attempt."""
    started = runner(env, gang, task=task)
    assert started.train() == 0
    return started


def tensors(value: Any, path: str = "") -> dict[str, Any]:
    """Every tensor and number in a loaded file, by path."""
    if isinstance(value, dict):
        return {k: v for key, item in value.items() for k, v in tensors(item, f"{path}/{key}").items()}
    if isinstance(value, list | tuple):
        return {k: v for i, item in enumerate(value) for k, v in tensors(item, f"{path}/{i}").items()}
    return {path: value}


def assert_same_bits(first: Path, second: Path) -> None:
    """Two checkpoints hold the same files with the same content; how long training took may differ."""
    names = sorted(path.name for path in first.glob("*.pt"))
    assert names == sorted(path.name for path in second.glob("*.pt")) and names
    for name in names:
        one, two = (tensors(torch.load(folder / name, weights_only=True)) for folder in (first, second))
        assert one.keys() == two.keys()
        for key in one.keys() - {"/progress/seconds"}:
            same = torch.equal(one[key], two[key]) if isinstance(one[key], torch.Tensor) else one[key] == two[key]
            assert same, f"{name}{key}"


def last(store: Path, run: str) -> Path:
    return list_checkpoints(Store(store).run(run))[-1].path
