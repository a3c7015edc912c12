"""Trainings on a GPU: that graphs are replayed without the host, and that no row of a rollout is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from worker.telemetry.rollout import Rollout


def training_of(store: Path, task: str, train: dict[str, Any], worlds: int = 256, **changes: Any) -> Any:
    """The training loop of a job, as the benchmarks build it."""
    from benchmarks.training import build

    return build(task, worlds, store, **{**train, **changes})


def iterates_without_waiting(store: Path, task: str, train: dict[str, Any]) -> None:
    """An iteration is a few graphs, and the host never waits for the device in it."""
    training = training_of(store, task, train)
    for _ in range(6):
        training._iterate()
    parts = [training._collecting, *training.algorithm.graphs]
    assert all(part.captured for part in parts) and training.task.captured
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            training._iterate()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert training.state.progress.iteration == 9


def has_a_row_for_each_step(store: Path, task: str, train: dict[str, Any]) -> None:
    """Each control step of a rollout is one row, however late the device is."""
    training = training_of(store, task, train, worlds=32, iterations=1)
    training.train()
    rollout = Rollout.of(training.job.run, {}, 1)
    work = torch.zeros(4096, 4096, device="cuda")
    for number, rows in enumerate(rollout.steps(20)):
        assert (rows.first, rows.lost, len(rows)) == (number, 0, 1)
        for _ in range(20):  # the device is behind the host
            work @ work
