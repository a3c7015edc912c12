"""The humanoid on the CPU: observation and reward by hand, what it reads of the model, actions, falls."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import newton.examples
import numpy as np
import pytest
import torch

from tests.support.worker.tasks import observe, play, put, statistics
from worker.tasks import find_task
from worker.tasks.humanoid import Humanoid, HumanoidConfig

FILE = ElementTree.parse(newton.examples.get_asset("nv_humanoid.xml")).getroot()
HINGES = {
    joint.get("name"): [math.radians(float(end)) for end in joint.get("range", "").split()]
    for joint in FILE.iter("joint")
    if joint.get("range")
}
JOINT_NAMES = tuple(HINGES)
GEARS = {motor.get("joint"): float(motor.get("gear", "nan")) for motor in FILE.iterfind("actuator/motor")}


@pytest.fixture(scope="module")
def humanoid() -> Humanoid:
    return Humanoid(HumanoidConfig(episode_seconds=0.5), 21, seed=1)


def test_it_is_found_and_its_sizes_are_those_of_its_names(humanoid: Humanoid) -> None:
    assert find_task("Humanoid") is Humanoid
    assert (humanoid.observation_shape, humanoid.action_size) == ((74,), 21)
    assert len(set(humanoid.observation_names)) == 74 and humanoid.action_names == JOINT_NAMES
    assert humanoid.config.ppo.hidden_sizes == (400, 200, 100)
    assert HumanoidConfig().control_hz == 60 and HumanoidConfig().substeps == 2


def test_joints_ranges_and_strengths_are_those_of_the_file(humanoid: Humanoid) -> None:
    robot = humanoid.robots["robot"]
    assert np.allclose(robot.ranges.numpy(), [HINGES[name] for name in JOINT_NAMES], atol=1e-6)
    assert np.allclose(robot.efforts.numpy(), [GEARS[name] for name in JOINT_NAMES])
    assert humanoid.numbers("rewards.energy.strongest").tolist() == [135.0]
    motors = list(GEARS)
    assert motors[:3] == ["abdomen_y", "abdomen_z", "abdomen_x"], "another order than the joints'"
    assert robot.actuators.numpy().tolist() == [motors.index(name) for name in JOINT_NAMES]


def test_every_action_drives_the_joint_that_it_is_named_after(humanoid: Humanoid) -> None:
    """World k uses half of motor k alone: the solver then has that torque on joint k and none on any other."""
    put(humanoid)
    humanoid.step(0.5 * torch.eye(21))
    torques = humanoid.worlds.solver.mjw_data.qfrc_actuator.numpy()
    assert not torques[:, :6].any()
    assert np.allclose(torques[:, 6:], np.diag([0.5 * GEARS[name] for name in JOINT_NAMES]))
    # the limits of joints, springs and dampers move others too: look at the change of velocity that the motor makes
    moved = humanoid.worlds.arrays.joint_qd.numpy()[:, 6:].copy()
    put(humanoid)
    humanoid.step(torch.zeros(21, 21))
    gained = (moved - humanoid.worlds.arrays.joint_qd.numpy()[:, 6:]).diagonal()
    assert (gained > 0.1).all()


def test_observation_and_reward_by_hand(humanoid: Humanoid) -> None:
    """Turned by 90 degrees about z, moving along +y (its own forward) at 2 m/s and yawing at 0.4 rad/s."""
    half = math.sqrt(0.5)
    middle = [sum(HINGES[name]) / 2 for name in JOINT_NAMES]
    knee, hip = JOINT_NAMES.index("left_knee"), JOINT_NAMES.index("right_hip_y")
    joints, velocities = list(middle), [0.0] * 21
    joints[knee] = HINGES["left_knee"][0] + 0.005 * (HINGES["left_knee"][1] - HINGES["left_knee"][0])  # scaled to -0.99
    joints[hip] += 0.25 * (HINGES["right_hip_y"][1] - HINGES["right_hip_y"][0])
    velocities[knee] = 4.0
    put(humanoid, joint_q=[[1.0, 2.0, 1.3, 0.0, 0.0, half, half, *joints]])
    state = humanoid.state_dict()
    state["joint_qd"][0] = torch.tensor([0.3, 2.0, 0.1, 0.0, 0.0, 0.4, *velocities])
    humanoid.load_state_dict(state)
    humanoid.actions.zero_()
    humanoid.actions[0, knee] = -3.0
    observe(humanoid)
    seen = dict(zip(humanoid.observation_names, humanoid.observations[0].tolist(), strict=True))
    assert seen["torso_height"] == pytest.approx(1.3)
    assert [seen[f"torso_velocity_{axis}"] for axis in "xyz"] == pytest.approx([2.0, -0.3, 0.1], abs=1e-5)
    assert [seen[f"torso_angular_velocity_{axis}"] for axis in "xyz"] == pytest.approx([0, 0, 0.1], abs=1e-6)
    assert seen["torso_yaw"] == pytest.approx(math.pi / 2, abs=1e-5)
    assert [seen[name] for name in ("torso_roll", "torso_up", "torso_heading")] == pytest.approx([0, 1, 0], abs=1e-6)
    assert seen["left_knee_position"] == pytest.approx(-0.99, abs=1e-5)
    assert seen["right_hip_y_position"] == pytest.approx(0.5, abs=1e-5)
    assert seen["abdomen_z_position"] == pytest.approx(0.0, abs=1e-6)
    assert seen["left_knee_velocity"] == pytest.approx(0.4) and seen["left_knee_previous_action"] == -1
    # forward 0.3, heading 0, up 0.1, alive 2, action 0.01 x 3², energy 0.05 x |1 x 4 x 0.1| and half of the last hundredth of the
    # range at 0.25, both times the knee's 90 of 135 N m
    expected = 0.3 + 0.0 + 0.1 + 2.0 - 0.09 - 0.05 * 0.4 * 90 / 135 - 0.25 * 0.5 * 90 / 135
    assert humanoid.rewards[0].item() == pytest.approx(expected, abs=1e-4)


def test_a_fallen_one_ends_its_episode_and_earns_only_the_fall(humanoid: Humanoid) -> None:
    put(humanoid, joint_q=[[0.0, 0.0, 0.79, 0.0, 0.0, 0.0, 1.0, *[0.0] * 21]], solver_warm_start=[[7.0] * 27] * 21)
    observe(humanoid)
    assert humanoid.dones.tolist() == [True] + [False] * 20 and not humanoid.time_outs.any()
    assert not humanoid.state_dict()["solver_warm_start"][0].any()
    assert humanoid.rewards[0] == -1.0
    assert humanoid.terminal_observations[0, 0].item() == pytest.approx(0.79)
    assert humanoid.observations[0, 0].item() == pytest.approx(1.34)
    assert not humanoid.observations[0, -21:].any(), "a new episode has no previous action"


def test_random_ones_fall_and_stay_finite_within_the_solvers_capacity() -> None:
    task = Humanoid(HumanoidConfig(), 32, seed=1)
    steps = play(task, 120, seed=2)
    assert all(step[0].isfinite().all() and step[1].isfinite().all() for step in steps)
    totals = statistics(task)
    assert totals["episodes"] > 32 and totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0
