"""Episodes begin more and more often where they fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.worker.declared import SmallConfig
from tests.support.worker.motion_task import HZ, SECONDS, WORLDS, Turning, motion


def started(task: Any, steps: int) -> np.ndarray:
    """The second of the motion with which each episode of these steps began."""
    found, rest = [], torch.zeros(task.world_count, 1)
    for _ in range(steps):
        task.step(rest)
        frames = task.sensors["motion"].state_tensors()["frames"][task.dones]
        found += ((frames - 1) // HZ).tolist()
    return np.array(found)


def test_episodes_begin_where_they_failed_and_a_checkpoint_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Turning, "motion", motion(tmp_path / "turning.npz"), raising=False)
    task, other = (Turning(SmallConfig(episode_seconds=10.0), WORLDS, seed=1) for _ in range(2))
    task.reset()
    first = started(task, 20)
    later = started(task, 150)
    shares = np.bincount(later.astype(int), minlength=SECONDS) / len(later)
    assert len(first) > 20 and shares[2] > 0.6 and (shares > 0).all(), shares
    assert float(task.sensors["motion"].arrays.sampling.evenness.numpy()[0]) < 0.9

    other.load_state_dict({name: value.clone() for name, value in task.state_dict().items()})
    assert started(task, 30).tolist() == started(other, 30).tolist()
    assert torch.equal(task.observations, other.observations)
