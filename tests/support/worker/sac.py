"""A small SAC for tests, and what compares its states."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch

from tests.support.worker.loop import setting_of
from tests.support.worker.point_task import Point, PointConfig
from worker.learning.algorithm import WorldShare
from worker.learning.distributed import Gang
from worker.learning.sac.sac import SAC
from worker.settings.sac import SACConfig

SMALL = SACConfig(
    steps=4,
    updates=4,
    batch_size=24,
    replay_steps=32,
    warm_up=4,
    actor_sizes=(16, 16),
    critic_sizes=(16, 12),
    atoms=11,
    v_min=-5.0,
    v_max=15.0,
    gamma=0.9,
    n_step=1,
)


def make(task: Any, seed: int = 1, gang: Gang | None = None, share: WorldShare | None = None, **settings: Any) -> SAC:
    torch.manual_seed(5)
    return SAC(dataclasses.replace(SMALL, **settings), setting_of(task, seed, gang, share))


def point(worlds: int = 6, first: int = 0) -> Point:
    return Point(PointConfig(), worlds, seed=3, first_world=first)


def same(left: Any, right: Any) -> bool:
    """Whether two nested states hold the same values, bit for bit."""
    if isinstance(left, torch.Tensor):
        return torch.equal(left, right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(value, right[key]) for key, value in left.items())
    if isinstance(left, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(left == right)
