"""The ant on the CPU: observation and reward by hand, actions, falls, solver capacity."""

from __future__ import annotations

import math

import pytest
import torch

from tests.support.worker.tasks import observe, play, put, statistics
from worker.tasks.ant import Ant, AntConfig


@pytest.fixture(scope="module")
def ant() -> Ant:
    return Ant(AntConfig(episode_seconds=0.5), 8, seed=1)


def test_ant_observation_and_reward_by_hand(ant: Ant) -> None:
    """An ant turned by 90 degrees about z, moving along +y (its own forward) at 2 m/s and yawing at 0.4 rad/s."""
    half = math.sqrt(0.5)
    joints = [0.0, math.radians(65.0), math.radians(20.0), math.radians(-100.0), 0.0, -1.0, 0.0, 1.0]
    put(
        ant,
        joint_q=[[1.0, 2.0, 0.5, 0.0, 0.0, half, half, *joints]],
        joint_qd=[[0.3, 2.0, 0.1, 0.0, 0.0, 0.4, 5.0, *[0.0] * 7]],
    )
    ant.actions.zero_()
    ant.actions[0, 0] = 2.0
    observe(ant)
    seen = dict(zip(ant.observation_names, ant.observations[0].tolist(), strict=True))
    assert seen["torso_height"] == pytest.approx(0.5)
    assert [seen[f"torso_velocity_{axis}"] for axis in "xyz"] == pytest.approx([2.0, -0.3, 0.1], abs=1e-5)
    assert [seen[f"torso_angular_velocity_{axis}"] for axis in "xyz"] == pytest.approx([0, 0, 0.1], abs=1e-6)
    assert seen["torso_yaw"] == pytest.approx(math.pi / 2, abs=1e-5)
    assert [seen[name] for name in ("torso_roll", "torso_up", "torso_heading")] == pytest.approx([0, 1, 0], abs=1e-6)
    assert seen["hip_1_position"] == 0 and seen["ankle_1_position"] == pytest.approx(0, abs=1e-6)
    assert seen["hip_2_position"] == pytest.approx(0.5, abs=1e-6)
    assert seen["ankle_2_position"] == pytest.approx(-1, abs=1e-6)
    assert seen["hip_1_velocity"] == pytest.approx(1.0) and seen["hip_1_previous_action"] == 1
    # forward 0.3, heading 0, up 0.1, alive 0.5, action 0.005 x 2², energy 0.05 x |1 x 5 x 0.2|, one joint at its limit
    assert ant.rewards[0].item() == pytest.approx(0.3 + 0.0 + 0.1 + 0.5 - 0.02 - 0.05 - 0.1, abs=1e-5)


def test_a_fallen_ant_ends_its_episode_and_earns_only_the_fall(ant: Ant) -> None:
    put(
        ant,
        joint_q=[[0.0, 0.0, 0.30, 0.0, 0.0, 0.0, 1.0, *[0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]]],
        solver_warm_start=[[7.0] * 14] * 8,
    )
    observe(ant)
    assert (ant.state_dict()["solver_warm_start"] == 7.0).all(dim=1).tolist() == [False] + [True] * 7
    assert not ant.state_dict()["solver_warm_start"][0].any()
    assert ant.dones.tolist() == [True] + [False] * 7 and not ant.time_outs.any()
    assert ant.rewards[0] == -2.0
    assert ant.terminal_observations[0, 0].item() == pytest.approx(0.30)
    assert ant.observations[0, 0].item() == pytest.approx(AntConfig().start_height)
    assert not ant.observations[0, -8:].any(), "a new episode has no previous action"


def test_every_ant_action_drives_the_joint_that_it_is_named_after(ant: Ant) -> None:
    """In the air and at rest, world k pushes joint k alone: that joint gains speed the fastest."""
    pose = [0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0, *[0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]]
    put(ant, joint_q=[pose] * 8, joint_qd=[[0.0] * 14] * 8)
    ant.step(torch.eye(8))
    names = ant.observation_names[19:27]
    assert [name.removesuffix("_velocity") for name in names] == list(ant.action_names)
    velocities = ant.observations[:, 19:27]
    assert velocities.abs().argmax(dim=1).tolist() == list(range(8))
    assert (velocities.diagonal() > 0.5).all()
    labels = [label.rsplit("/", 1)[-1] for label in ant.worlds.model.joint_label[1:9]]
    assert labels == list(ant.action_names)


def test_ants_stand_and_random_ones_stay_finite(ant: Ant) -> None:
    put(ant)
    for _ in range(29):
        ant.step(torch.zeros(8, 8))
        assert not ant.dones.any()
    assert (ant.observations[:, 0] > 0.4).all() and (ant.observations[:, 9] > 0.95).all()
    assert all(step[0].isfinite().all() for step in play(ant, 60, seed=2))
    totals = statistics(ant)
    assert totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0


def test_overflow_of_the_solver_is_counted() -> None:
    """Four feet on the ground need 16 rows; give the solver 10."""

    class Cramped(Ant):
        solver_options = {**Ant.solver_options, "njmax": 10}

    cramped = Cramped(AntConfig(), 2, seed=1)
    for _ in range(20):
        cramped.step(torch.zeros(2, 8))
    assert 0 < statistics(cramped)["solver_overflows"] <= 40
