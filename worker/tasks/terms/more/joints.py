"""Joints: further measurements, costs and limits."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import wrapped_angle
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.composing import above, composed, difference, magnitude, squared
from worker.tasks.terms.joints import (
    joint_effort,
    joint_offset,
    joint_position,
    joint_speed,
    joint_velocity,
    measured_joint_position,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def measured_joint_offset(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint relative to its default, measured by its encoder: with the encoder's bias [m, rad].

    mjlab: joint_pos_rel(biased=True).
    """
    return measured_joint_position(world, worlds, robot, joint) - robot.defaults[joint]


@needs(some_ranges=True)
@wp.func
def joint_share_of_range(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint between its limits: -1 at the lower, 0 in the middle, 1 at the upper; 0 for a joint without limits.

    Isaac Lab: joint_pos_limit_normalized.
    """
    ends = robot.ranges[joint]
    if not wp.isfinite(ends[1] - ends[0]):
        return 0.0
    return (2.0 * joint_position(world, worlds, robot, joint) - ends[0] - ends[1]) / (ends[1] - ends[0])


@wp.func
def joint_acceleration(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Acceleration of a joint in the last physics step [m/s^2, rad/s^2].

    Use it in rewards: the solver starts the next step from it, and a reset sets it to 0.
    """
    return worlds.warm_start[world, robot.dofs[joint]]


@wp.func
def joint_effort_share(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Force or torque of the actuator on a joint over its greatest one, in [-1, 1]; 0 without a limit."""
    return joint_effort(world, worlds, robot, joint) / robot.efforts[joint]


@wp.func
def joint_power(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Mechanical power that the actuator gives a joint, force times velocity [W]; negative while it brakes."""
    return joint_effort(world, worlds, robot, joint) * joint_velocity(world, worlds, robot, joint)


@wp.func
def joint_velocity_excess(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, limit: float) -> float:
    """Excess of a joint's speed over ``limit``, at most 1 [m/s, rad/s].

    Isaac Lab: joint_vel_limits (limit: soft_ratio times the joint's limit).
    """
    return wp.clamp(joint_speed(world, worlds, robot, joint) - limit, 0.0, 1.0)


@composed(squared, joint_acceleration)
def joint_acceleration_squared():
    """Square of a joint's acceleration in the last physics step [m^2/s^4, rad^2/s^4].

    mjlab: joint_acc_l2. Isaac Lab: joint_acc_l2 (which takes the difference of two velocities).
    """


@composed(magnitude, joint_effort)
def joint_effort_magnitude():
    """Magnitude of the actuator's force or torque on a joint [N, N m]."""


@needs(efforts=True)
@wp.func
def joint_effort_excess(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, soft_factor: float = 0.9
) -> float:
    """Excess of the actuator's force or torque over ``soft_factor`` times its greatest one [N, N m].

    Isaac Lab: applied_torque_limits (which counts what the actuator cut off).
    """
    return wp.max(wp.abs(joint_effort(world, worlds, robot, joint)) - soft_factor * robot.efforts[joint], 0.0)


@wp.func
def joint_work(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Mechanical power that an actuator spends on a joint [W]; braking recovers none. mjlab: electrical_power_cost."""
    return wp.max(joint_power(world, worlds, robot, joint), 0.0)


@composed(magnitude, joint_power)
def joint_power_magnitude():
    """Magnitude of the mechanical power between an actuator and its joint [W]; braking costs as much as driving.

    Isaac Lab: power_consumption (of the classic tasks, which take the action for the torque).
    """


@composed(magnitude, joint_offset)
def joint_deviation():
    """Distance of a joint from its default position [m, rad]. Isaac Lab: joint_deviation_l1."""


@composed(squared, wrapped_angle, difference, joint_position)
def joint_target_error_squared(target: float = 0.0):
    """Square of the angle between a hinge and ``target``, the shorter way round [rad^2].

    Isaac Lab: joint_pos_target_l2 (of cartpole).
    """


@wp.func
def joint_beyond_limits(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> bool:
    """Whether a joint is beyond its limits. Isaac Lab: joint_pos_out_of_limit."""
    position = joint_position(world, worlds, robot, joint)
    return position < robot.ranges[joint][0] or position > robot.ranges[joint][1]


@composed(above, joint_speed)
def joint_too_fast(limit: float):
    """Whether a joint is faster than ``limit`` [m/s, rad/s].

    Isaac Lab: joint_vel_out_of_manual_limit, joint_vel_out_of_limit.
    """


@needs(efforts=True)
@wp.func
def joint_effort_at_limit(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, soft_factor: float = 1.0
) -> bool:
    """Whether the actuator's force or torque on a joint is at least ``soft_factor`` times its greatest one.

    Isaac Lab: joint_effort_out_of_limit.
    """
    return wp.abs(joint_effort(world, worlds, robot, joint)) >= soft_factor * robot.efforts[joint]
