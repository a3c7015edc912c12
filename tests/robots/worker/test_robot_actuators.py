"""Declared actuators against their laws by hand: servos, motors with a torque-speed line, delays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from tests.support.worker.robots import build
from worker.simulation.actuators import (
    Actuator,
    DCMotorActuator,
    EffortActuator,
    ExplicitPDActuator,
    PositionActuator,
    VelocityActuator,
)
from worker.simulation.robot import Robot
from worker.simulation.robot_view import RobotView

STEP = 0.005
# Two wheels of inertia 0.02 kg m^2 about their own axes, which gravity doesn't move; one counts its angle from 0.3 rad.
WHEELS = """<mujoco model="wheels"><option integrator="implicitfast"/><worldbody>
  <body name="left" pos="0 0 1"><joint name="left_axle" type="hinge" axis="0 1 0" {left}/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/><geom size="0.05" contype="0" conaffinity="0"/></body>
  <body name="right" pos="0 1 1"><joint name="right_axle" type="hinge" axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/><geom size="0.05" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
INERTIA = 0.02


def wheels(*actuators: Actuator, worlds: int = 1, substeps: int = 1, left: str = ""):
    robot = Robot(WHEELS.format(left=left), actuators=actuators)
    template, built = build(robot, worlds=worlds, ground=False, timestep=STEP, substeps=substeps)
    built.restore_defaults()
    return RobotView(template), built


def set_state(worlds, positions, velocities) -> None:
    """The same positions [rad] and velocities [rad/s] of both wheels in all worlds."""
    worlds.arrays.joint_q.assign(np.tile(np.float32(positions), (worlds.world_count, 1)))
    worlds.arrays.joint_qd.assign(np.tile(np.float32(velocities), (worlds.world_count, 1)))


def force_of(worlds, controls, positions=(0.0, 0.0), velocities=(0.0, 0.0)) -> np.ndarray:
    """Torques on the wheels in the next physics step [N m], shape (worlds, 2)."""
    set_state(worlds, positions, velocities)
    worlds.arrays.controls.assign(np.tile(np.float32(controls), (worlds.world_count, 1)))
    worlds.simulate()
    return worlds.arrays.drives.numpy().copy()


@pytest.mark.parametrize(
    ("actuator", "control", "expected"),
    [
        (PositionActuator("*", 30.0, 2.0), 0.5, 30.0 * (0.5 - 0.2) - 2.0 * 1.5),
        (PositionActuator("*", 30.0, 2.0, effort_limit=4.0), 0.5, 4.0),
        (VelocityActuator("*", 2.0), 3.0, 2.0 * (3.0 - 1.5)),
        (EffortActuator("*"), 0.7, 0.7),
        (EffortActuator("*", effort_limit=0.4), -0.7, -0.4),
        (ExplicitPDActuator("*", 30.0, 2.0), 0.5, 30.0 * (0.5 - 0.2) - 2.0 * 1.5),
        (ExplicitPDActuator("*", 30.0, 2.0, effort_limit=4.0), 0.5, 4.0),
    ],
    ids=["position", "position limited", "velocity", "effort", "effort limited", "PD", "PD limited"],
)
def test_the_force_of_an_actuator_is_its_law(actuator: Actuator, control: float, expected: float):
    _, worlds = wheels(actuator)
    forces = force_of(worlds, (control, control), (0.2, 0.2), (1.5, 1.5))
    np.testing.assert_allclose(forces, expected, rtol=1e-4)


def test_a_native_servo_damps_implicitly_and_an_explicit_one_does_not():
    """By hand: v' = v - dt kd v' / I against v' = v - dt kd v / I, which at this damping overshoots."""
    damping = 1.5 * INERTIA / STEP
    for actuator, expected in (
        (PositionActuator("*", 0.0, damping), 2.0 / 2.5),
        (ExplicitPDActuator("*", 0.0, damping), 2.0 * (1 - 1.5)),
    ):
        _, worlds = wheels(actuator)
        force_of(worlds, (0.0, 0.0), velocities=(2.0, 2.0))
        np.testing.assert_allclose(worlds.arrays.joint_qd.numpy(), expected, rtol=1e-4)


def test_a_dc_motor_follows_its_torque_speed_line():
    stall, free, limit = 6.0, 20.0, 4.0
    motor = DCMotorActuator("*", 1000.0, 0.0, saturation_effort=stall, velocity_limit=free, effort_limit=limit)
    _, worlds = wheels(motor)
    for speed in (-30.0, -10.0, 0.0, 5.0, 10.0, 19.0, 20.0, 25.0):
        forward = force_of(worlds, (1.0, 1.0), velocities=(speed, speed))[0, 0]
        back = force_of(worlds, (-1.0, -1.0), velocities=(speed, speed))[0, 0]
        # the line is followed down to the speed at which it brakes with all it has
        line = np.clip(speed, -free * (1 + limit / stall), free * (1 + limit / stall)) / free
        assert forward == pytest.approx(min(stall * (1 - line), limit), abs=1e-4), speed
        assert back == pytest.approx(max(stall * (-1 - line), -limit), abs=1e-4), speed


def test_explicit_motors_see_the_state_of_each_physics_step():
    """Four physics steps of one call, against the same recursion by hand."""
    kp, kd = 8.0, 0.1
    _, worlds = wheels(ExplicitPDActuator("*", kp, kd), substeps=4)
    set_state(worlds, (0.2, -0.1), (0.0, 1.0))
    worlds.arrays.controls.assign(np.float32([[0.5, 0.5]]))
    worlds.simulate()
    position, velocity = np.array([0.2, -0.1]), np.array([0.0, 1.0])
    for _ in range(4):
        velocity = velocity + STEP * (kp * (0.5 - position) - kd * velocity) / INERTIA
        position = position + STEP * velocity
    np.testing.assert_allclose(worlds.arrays.joint_q.numpy()[0], position, rtol=1e-4)
    np.testing.assert_allclose(worlds.arrays.joint_qd.numpy()[0], velocity, rtol=1e-4)


@pytest.mark.parametrize("kind", [PositionActuator, ExplicitPDActuator])
def test_inputs_count_as_the_file_does(kind: type[Actuator]):
    """At its target, a joint with a ref of 0.3 rad feels no force."""
    view, worlds = wheels(kind("*", 10.0, 0.0), left='ref="17.188733853924695"')
    np.testing.assert_allclose(view.references, [0.3, 0.0], rtol=1e-6)
    forces = force_of(worlds, (0.25 + 0.3, 0.25), (0.25, 0.25))
    np.testing.assert_allclose(forces, 0.0, atol=1e-5)


@pytest.mark.parametrize("kind", [EffortActuator, PositionActuator, ExplicitPDActuator])
def test_a_delayed_input_is_obeyed_so_many_physics_steps_later(kind: type[Actuator]):
    gains = () if kind is EffortActuator else (1.0, 0.0)
    delayed = kind("left*", *gains, delay=3)
    _, worlds = wheels(delayed, kind("right*", *gains), worlds=2)
    forces = [force_of(worlds, (0.1 * step, 0.1 * step))[:, :] for step in range(1, 8)]
    # the first input is held until an input of three steps before is there
    expected = [[0.1 * max(1, step - 3), 0.1 * step] for step in range(1, 8)]
    for of_worlds in np.moveaxis(np.array(forces), 1, 0):
        np.testing.assert_allclose(of_worlds, expected, rtol=1e-4)

    ages = wp.array([0, 5], dtype=wp.int32)
    worlds.drives.settle(ages)
    after = force_of(worlds, (0.9, 0.9))
    np.testing.assert_allclose(after, [[0.9, 0.9], [0.5, 0.9]], rtol=1e-4)


def test_delays_are_part_of_the_state():
    """Two worlds that change places go on as each would have, which a ring shared by all worlds could not do."""
    _, worlds = wheels(EffortActuator("*", delay=2), worlds=2)
    inputs = np.float32([[1.0, 2.0], [3.0, 4.0]])
    for scale in (1.0, 2.0, 3.0):
        worlds.arrays.controls.assign(scale * inputs)
        worlds.simulate()
        if scale == 2.0:
            worlds.drives.settle(wp.array([1, 0], dtype=wp.int32))
    for tensor in worlds.drives.state_tensors().values():
        assert tensor.shape[0] == 2
        tensor.copy_(tensor.flip(0).clone())
    worlds.arrays.controls.assign(np.float32([[7.0, 7.0], [8.0, 8.0]]))
    worlds.simulate()
    # world 0 has now world 1's past: the episode that began with input 3 [3, 4]; world 1 has world 0's second input
    np.testing.assert_allclose(worlds.arrays.drives.numpy(), [[9.0, 12.0], [2.0, 4.0]], rtol=1e-5)


def test_numbers_by_pattern_of_joints():
    numbers = {"armature": {"right*": 0.5, "*": 0.1}, "friction_loss": 0.01}
    view, worlds = wheels(PositionActuator("*", {"left*": 10.0, "*": 20.0}, 0.0, **numbers))
    model = worlds.solver.mj_model
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], [10.0, 20.0])
    np.testing.assert_allclose(model.dof_armature, [0.1, 0.5], rtol=1e-6)
    np.testing.assert_allclose(model.dof_frictionloss, [0.01, 0.01], rtol=1e-6)
    assert view.efforts == [math.inf, math.inf]


def test_the_actuators_of_a_file_are_kept_and_follow_the_controls():
    actuators = '<position joint="right_axle" kp="5"/><motor joint="left_axle" gear="2" ctrlrange="-3 3"/>'
    text = WHEELS.format(left="").replace("</mujoco>", f"<actuator>{actuators}</actuator></mujoco>")
    template, worlds = build(Robot(text), ground=False)
    view = RobotView(template)
    assert view.actuators == [1, 0]
    assert view.efforts == [6.0, math.inf]
    worlds.restore_defaults()
    worlds.arrays.controls.assign(np.float32([[0.4, 0.5]]))
    worlds.simulate()
    np.testing.assert_allclose(worlds.arrays.drives.numpy()[0], [1.0, 2.0], rtol=1e-5)


def test_a_step_with_motors_and_delays_is_recorded_once_and_replayed():
    """In a graph nothing may be read on the host: the replayed steps are those of direct calls."""
    actuators = (
        DCMotorActuator("left*", 9.0, 0.2, saturation_effort=2.0, velocity_limit=9.0, delay=2),
        PositionActuator("right*", 5.0, 0.1),
    )
    _, direct = wheels(*actuators, substeps=2)
    _, replayed = wheels(*actuators, substeps=2)
    for worlds in (direct, replayed):
        worlds.arrays.controls.assign(np.float32([[0.5, -0.5]]))
    with wp.ScopedCapture(device="cpu") as capture:
        replayed.simulate()
    set_state(replayed, (0.0, 0.0), (0.0, 0.0))
    replayed.drives.forget()
    replayed.arrays.warm_start.zero_()
    for _ in range(5):
        direct.simulate()
        wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(replayed.arrays.joint_q.numpy(), direct.arrays.joint_q.numpy())
