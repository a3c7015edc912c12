"""The humanoid on the CPU: what it reads of the model, actions, falls. What it sees and earns: tests/unit/worker/test_task_formulas.py."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import newton.examples
import numpy as np
import pytest
import torch

from tests.support.worker.tasks import play, put, statistics
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


def test_random_ones_fall_and_stay_finite_within_the_solvers_capacity() -> None:
    task = Humanoid(HumanoidConfig(), 32, seed=1)
    steps = play(task, 120, seed=2)
    assert all(step[0].isfinite().all() and step[1].isfinite().all() for step in steps)
    totals = statistics(task)
    assert totals["episodes"] > 32 and totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0
