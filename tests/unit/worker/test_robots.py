"""Robots whose controls nothing would read, and options of the solver that are not a task's, are refused in one line."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable
from typing import Any

import newton
import pytest
import torch
import warp as wp

from job_specs.my_kernels import PendulumByHand, PendulumConfig
from worker.errors import UserError
from worker.learning.job import user_errors
from worker.simulation.patterns import resolve

MJCF = """<mujoco><worldbody><body pos="0 0 1">
  <joint name="hinge" type="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
  <body pos="0 0 -0.5"><joint name="knee" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/></body>
</body></worldbody><actuator>{}</actuator></mujoco>"""
URDF = """<robot name="arm"><link name="base"/><link name="tip"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""
SERVOS = '<position name="servo" joint="hinge" kp="30" kv="3"/><velocity joint="knee" kv="1"/>'
MIXED = '<motor joint="knee"/><position joint="hinge"/>'


def robot(add: Callable[[newton.ModelBuilder], Any], **options: Any) -> type[PendulumByHand]:
    """A task with this robot; a state of a joint is all that the pendulum's kernels need."""

    class Robot(PendulumByHand):
        solver_options = {"disable_contacts": True, "njmax": 4, "nconmax": 0, **options}

        def build(self, builder: newton.ModelBuilder) -> None:
            add(builder)

    return Robot


def mjcf(actuators: str, **options: Any) -> Callable[[newton.ModelBuilder], Any]:
    return lambda builder: builder.add_mjcf(MJCF.format(actuators), **options)


@pytest.mark.parametrize(
    ("add", "parts"),
    [
        (mjcf(SERVOS), ["actuators of joints hinge, knee would ignore", "ctrl_direct=True"]),
        (mjcf(MIXED), ["actuators of joint hinge would", "ctrl_direct=True"]),
        (lambda builder: builder.add_urdf(URDF), ["nothing would drive the robot: joint elbow follow", "in MJCF"]),
        (mjcf(""), ["the robot has no actuators", "<actuator>"]),
    ],
)
def test_a_robot_that_no_action_would_move_is_refused(
    add: Callable[[newton.ModelBuilder], Any], parts: list[str]
) -> None:
    with pytest.raises(UserError) as error, user_errors():
        robot(add)(PendulumConfig(), 2)
    assert str(error.value).startswith("task Robot: ") and "\n" not in str(error.value)
    assert all(part in str(error.value) for part in parts), str(error.value)


def test_the_same_servos_added_as_the_refusal_says_follow_their_controls() -> None:
    task = robot(mjcf(SERVOS, ctrl_direct=True))(PendulumConfig(), 2, seed=1)
    controls, angles = wp.to_torch(task.worlds.arrays.controls), wp.to_torch(task.worlds.arrays.joint_q)
    controls.copy_(torch.tensor([[0.3, 0.0], [-0.3, 0.0]]))
    for _ in range(120):
        task.worlds.simulate()
    assert angles[0, 0] > 0.2 and angles[1, 0] < -0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"disable_sensors": False}, "disable_sensors is always True here; leave it out"),
        ({"separate_worlds": True}, "separate_worlds is always True here; leave it out"),
        ({"iteration": 4}, "SolverMuJoCo has no option 'iteration'; did you mean iterations?"),
        ({"model": None}, "SolverMuJoCo has no option 'model'; "),
    ],
)
def test_an_option_of_the_solver_that_is_not_a_task_s_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r"task Robot: solver_options: ") as error:
        robot(mjcf('<motor joint="hinge"/>'), **options)(PendulumConfig(), 2)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_values_by_pattern_may_come_in_any_mapping() -> None:
    values = UserDict({"left_*": 1.0, "*": 2.0})
    assert resolve(["left_knee", "right_knee"], values, "joint") == [1.0, 2.0]
