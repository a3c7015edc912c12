"""Joints: positions, velocities, forces of the actuators, limits.

Each function is called for one joint; rewards are summed over the joints of the term.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import wrapped_angle
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs

wp.set_module_options({"enable_backward": False})


@wp.func
def joint_position(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint [m, rad].

    mjlab: -. Isaac Lab: joint_pos.
    """
    return worlds.joint_q[world, robot.coordinates[joint]]


@wp.func
def measured_joint_position(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint measured by its encoder: position + encoder bias [m, rad].

    mjlab: -. Isaac Lab: -.
    """
    return joint_position(world, worlds, robot, joint) + robot.encoder_bias[world, joint]


@wp.func
def joint_offset(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint relative to its default [m, rad].

    mjlab: joint_pos_rel. Isaac Lab: joint_pos_rel.
    """
    return joint_position(world, worlds, robot, joint) - robot.defaults[joint]


@wp.func
def measured_joint_offset(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint relative to its default, measured by its encoder: with the encoder's bias [m, rad].

    mjlab: joint_pos_rel(biased=True). Isaac Lab: -.
    """
    return measured_joint_position(world, worlds, robot, joint) - robot.defaults[joint]


@wp.func
def joint_velocity(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Velocity of a joint [m/s, rad/s].

    mjlab: joint_vel_rel. Isaac Lab: joint_vel_rel, joint_vel.
    """
    return worlds.joint_qd[world, robot.dofs[joint]]


@needs(some_ranges=True)
@wp.func
def joint_share_of_range(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint between its limits: -1 at the lower, 0 in the middle, 1 at the upper; 0 for a joint without limits.

    mjlab: -. Isaac Lab: joint_pos_limit_normalized.
    """
    ends = robot.ranges[joint]
    if not wp.isfinite(ends[1] - ends[0]):
        return 0.0
    return (2.0 * joint_position(world, worlds, robot, joint) - ends[0] - ends[1]) / (ends[1] - ends[0])


@wp.func
def joint_acceleration(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Acceleration of a joint in the last physics step [m/s^2, rad/s^2].

    Use it in rewards: the solver starts the next step from it, and a reset sets it to 0.

    mjlab: -. Isaac Lab: -.
    """
    return worlds.warm_start[world, robot.dofs[joint]]


@wp.func
def joint_effort(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Force or torque of the actuator on a joint in the last physics step [N, N m].

    mjlab: -. Isaac Lab: joint_effort.
    """
    return worlds.drives[world, robot.dofs[joint]]


@wp.func
def joint_effort_share(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Force or torque of the actuator on a joint over its greatest one, in [-1, 1]; 0 without a limit.

    mjlab: -. Isaac Lab: -.
    """
    return joint_effort(world, worlds, robot, joint) / robot.efforts[joint]


@wp.func
def joint_power(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Mechanical power that the actuator gives a joint, force times velocity [W]; negative while it brakes.

    mjlab: -. Isaac Lab: -.
    """
    return joint_effort(world, worlds, robot, joint) * joint_velocity(world, worlds, robot, joint)


@needs(some_ranges=True)
@wp.func
def joint_limit_excess(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, soft_factor: float = 0.95
) -> float:
    """Distance of a joint beyond its soft limits [m, rad], at ``soft_factor`` times the range about its middle; 0 without limits.

    mjlab: joint_pos_limits. Isaac Lab: joint_pos_limits.
    """
    ends = robot.ranges[joint]
    margin = 0.5 * (1.0 - soft_factor) * (ends[1] - ends[0])
    if not wp.isfinite(margin):
        margin = 0.0
    position = joint_position(world, worlds, robot, joint)
    return wp.max(ends[0] + margin - position, 0.0) + wp.max(position - ends[1] + margin, 0.0)


@wp.func
def joint_velocity_squared(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Square of a joint's velocity [m^2/s^2, rad^2/s^2].

    mjlab: joint_vel_l2. Isaac Lab: joint_vel_l2.
    """
    velocity = joint_velocity(world, worlds, robot, joint)
    return velocity * velocity


@wp.func
def joint_speed(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Magnitude of a joint's velocity [m/s, rad/s].

    mjlab: -. Isaac Lab: joint_vel_l1.
    """
    return wp.abs(joint_velocity(world, worlds, robot, joint))


@wp.func
def joint_velocity_excess(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, limit: float) -> float:
    """Excess of a joint's speed over ``limit``, at most 1 [m/s, rad/s].

    mjlab: -. Isaac Lab: joint_vel_limits (limit: soft_ratio times the joint's limit).
    """
    return wp.clamp(joint_speed(world, worlds, robot, joint) - limit, 0.0, 1.0)


@wp.func
def joint_velocity_excess_squared(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, limit: float
) -> float:
    """Square of the excess of a joint's speed over ``limit`` [m^2/s^2, rad^2/s^2].

    mjlab: joint_velocity_hinge_penalty (limit: max_vel). Isaac Lab: -.
    """
    excess = wp.max(joint_speed(world, worlds, robot, joint) - limit, 0.0)
    return excess * excess


@wp.func
def joint_acceleration_squared(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Square of a joint's acceleration in the last physics step [m^2/s^4, rad^2/s^4].

    mjlab: joint_acc_l2. Isaac Lab: joint_acc_l2 (which takes the difference of two velocities).
    """
    acceleration = joint_acceleration(world, worlds, robot, joint)
    return acceleration * acceleration


@wp.func
def joint_effort_squared(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Square of the actuator's force or torque on a joint [N^2, N^2 m^2].

    mjlab: joint_torques_l2 (which takes the force of the actuator, before its gear). Isaac Lab: joint_torques_l2.
    """
    effort = joint_effort(world, worlds, robot, joint)
    return effort * effort


@wp.func
def joint_effort_magnitude(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Magnitude of the actuator's force or torque on a joint [N, N m].

    mjlab: -. Isaac Lab: -.
    """
    return wp.abs(joint_effort(world, worlds, robot, joint))


@needs(efforts=True)
@wp.func
def joint_effort_excess(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, soft_factor: float = 0.9
) -> float:
    """Excess of the actuator's force or torque over ``soft_factor`` times its greatest one [N, N m].

    mjlab: -. Isaac Lab: applied_torque_limits (which counts what the actuator cut off).
    """
    return wp.max(wp.abs(joint_effort(world, worlds, robot, joint)) - soft_factor * robot.efforts[joint], 0.0)


@wp.func
def joint_work(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Mechanical power that an actuator spends on a joint [W]; braking recovers nothing.

    mjlab: electrical_power_cost. Isaac Lab: -.
    """
    return wp.max(joint_power(world, worlds, robot, joint), 0.0)


@wp.func
def joint_power_magnitude(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Magnitude of the mechanical power between an actuator and its joint [W]; braking costs as much as driving.

    mjlab: -. Isaac Lab: power_consumption (of the classic tasks, which take the action for the torque).
    """
    return wp.abs(joint_power(world, worlds, robot, joint))


@wp.func
def joint_deviation(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Distance of a joint from its default position [m, rad].

    mjlab: -. Isaac Lab: joint_deviation_l1.
    """
    return wp.abs(joint_offset(world, worlds, robot, joint))


@wp.func
def joint_deviation_squared(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Square of a joint's distance from its default position [m^2, rad^2].

    mjlab: -. Isaac Lab: -.
    """
    offset = joint_offset(world, worlds, robot, joint)
    return offset * offset


@wp.func
def joint_target_error_squared(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, target: float = 0.0
) -> float:
    """Square of the angle between a hinge and ``target``, the shorter way round [rad^2].

    mjlab: -. Isaac Lab: joint_pos_target_l2 (of cartpole).
    """
    error = wrapped_angle(joint_position(world, worlds, robot, joint) - target)
    return error * error


@wp.func
def joint_beyond_limits(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> bool:
    """Whether a joint is beyond its limits.

    mjlab: -. Isaac Lab: joint_pos_out_of_limit.
    """
    position = joint_position(world, worlds, robot, joint)
    return position < robot.ranges[joint][0] or position > robot.ranges[joint][1]


@wp.func
def joint_out_of_range(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, bounds: wp.vec2) -> bool:
    """Whether a joint is below the first or above the second of ``bounds`` [m, rad].

    mjlab: -. Isaac Lab: joint_pos_out_of_manual_limit.
    """
    position = joint_position(world, worlds, robot, joint)
    return position < bounds[0] or position > bounds[1]


@wp.func
def joint_too_fast(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, limit: float) -> bool:
    """Whether a joint is faster than ``limit`` [m/s, rad/s].

    mjlab: -. Isaac Lab: joint_vel_out_of_manual_limit, joint_vel_out_of_limit.
    """
    return wp.abs(joint_velocity(world, worlds, robot, joint)) > limit


@needs(efforts=True)
@wp.func
def joint_effort_at_limit(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, soft_factor: float = 1.0
) -> bool:
    """Whether the actuator's force or torque on a joint is at least ``soft_factor`` times its greatest one.

    mjlab: -. Isaac Lab: joint_effort_out_of_limit.
    """
    return wp.abs(joint_effort(world, worlds, robot, joint)) >= soft_factor * robot.efforts[joint]
