"""The judgement of policies: velocities as MuJoCo's own engine has them, over the steps of first episodes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.peers.conversion import PlainPolicy
from benchmarks.peers.judging import COMMAND, VelocityErrors, judge
from tests.support.worker.walkers import Twin, plain
from worker.tasks.library.velocity import Velocity

WORLDS, STEPS = 3, 8
FEET = [[f"{leg}_foot_collision"] for leg in ("FR", "FL", "RR", "RL")]


@pytest.fixture(scope="module")
def task() -> Velocity:
    return plain("Go1Flat", WORLDS, episode_seconds=STEPS / 50.0)


def by_mujoco(task: Velocity, twin: Twin, commands: np.ndarray) -> np.ndarray:
    """Linear and angular error of each world, from its state put into MuJoCo."""
    rows = []
    for world in range(WORLDS):
        twin.take(task.worlds.arrays.joint_q.numpy()[world], task.worlds.arrays.joint_qd.numpy()[world])
        mujoco.mj_forward(twin.model, twin.data)
        linear, angular = twin.velocity(mujoco.mjtObj.mjOBJ_XBODY, "trunk", True)
        rows.append([np.linalg.norm(linear[:2] - commands[world, :2]), abs(angular[2] - commands[world, 2])])
    return np.array(rows)


def test_errors_and_their_means_are_those_of_mujocos_velocities(task: Velocity) -> None:
    twin, measured = Twin(task, FEET), VelocityErrors(task)
    generator = torch.Generator().manual_seed(2)
    # a policy that moves the robot about, by what it sees
    layer = torch.randn(task.action_size, len(task.observation_names), generator=generator) * 0.3
    policy = PlainPolicy([(layer, torch.zeros(task.action_size))], None, None)
    columns = [list(task.observation_names).index(name) for name in COMMAND]
    task.seed(7)
    task.reset()
    errors, returns = [], np.zeros(WORLDS)
    for step in range(STEPS):
        commands = task.observations[:, columns].clone()
        assert torch.equal(measured.commands(), commands) and commands.abs().sum() > 0.1
        task.step(task.observations @ layer.T)
        returns += task.rewards.numpy()
        assert bool(task.dones.any()) == (step == STEPS - 1)  # nobody falls: the clock alone ends it
        if step < STEPS - 1:
            errors.append(by_mujoco(task, twin, commands.numpy()))
            np.testing.assert_allclose(measured.errors(commands).numpy(), errors[-1], atol=2e-4)
    assert np.ptp(errors) > 0.1
    task.seed(7)
    found = judge(task, policy)
    np.testing.assert_allclose(
        [found.linear_error, found.angular_error], np.mean(np.concatenate(errors), axis=0), atol=2e-4
    )
    assert (found.episodes, found.length_share, found.full_length) == (WORLDS, 1.0, 1.0)
    np.testing.assert_allclose(found.mean_return, returns.mean(), rtol=1e-4)


def test_an_episode_that_a_fall_ends_is_shorter(task: Velocity) -> None:
    """A world that starts on its back falls in its first step, and what it does afterwards does not count."""
    task.seed(7)
    rest = PlainPolicy([(torch.zeros(task.action_size, len(task.observation_names)), torch.zeros(12))], None, None)
    start = task.reset

    def on_its_back() -> None:
        start()
        state = task.state_dict()
        state["joint_q"][0, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        task.load_state_dict(state)

    task.reset = on_its_back
    found = judge(task, rest)
    task.reset = start
    assert found.length_share == pytest.approx(((WORLDS - 1) * STEPS + 1) / (WORLDS * STEPS))
    assert found.full_length == pytest.approx((WORLDS - 1) / WORLDS)
