"""A task as an environment of rsl_rl: copies in floats, what it logs, its clocks."""

from __future__ import annotations

import pytest
import torch

from tests.support.worker.rsl_loop import Seen
from worker.tasks.rsl_rl_env import TaskVecEnv


def test_an_environment_hands_out_copies_in_floats() -> None:
    task = Seen(seed=3)
    env = TaskVecEnv(task)  # type: ignore[arg-type]
    first = env.get_observations()
    image = first["image"].clone()
    assert list(first.keys()) == ["policy", "critic", "place", "image"] and image.dtype == torch.float32
    assert {float(image.min()), float(image.max())} == {-0.5, 0.5}
    observations, rewards, dones, extras = env.step(torch.ones(8, 1))
    assert torch.equal(first["image"], image) and not torch.equal(observations["policy"], first["policy"])
    assert rewards.data_ptr() != task.rewards.data_ptr() and dones.dtype == torch.int64
    assert extras["time_outs"].dtype == torch.float32 and "log" not in extras
    assert env.unwrapped.step_dt == pytest.approx(0.1) and env.cfg["control_hz"] == 10.0


def test_an_environment_logs_what_the_terms_of_the_reward_came_to() -> None:
    task = Seen(seed=3)
    env = TaskVecEnv(task)  # type: ignore[arg-type]
    returns = torch.zeros(8)
    for _ in range(5):
        *_, dones, extras = env.step(torch.zeros(8, 1))
        returns += task.rewards
    assert dones.bool().all()  # episodes of 0.5 s
    torch.testing.assert_close(extras["log"]["reward_place"], returns.mean().expand(8))


def test_setting_the_clock_of_an_environment_sets_that_of_the_task() -> None:
    task = Seen(seed=3)
    env = TaskVecEnv(task)  # type: ignore[arg-type]
    buffer = task.episode_length
    env.episode_length_buf = torch.tensor([4, 3, 2, 1, 0, 0, 0, 0])
    *_, dones, extras = env.step(torch.zeros(8, 1))
    assert dones.tolist() == [1, 0, 0, 0, 0, 0, 0, 0] and extras["time_outs"].tolist() == dones.tolist()
    assert task.episode_length is buffer and env.episode_length_buf.tolist() == [0, 4, 3, 2, 1, 1, 1, 1]
