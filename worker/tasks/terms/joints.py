"""Joints: positions, velocities, forces of the actuators, limits.

Each function is called for one joint; rewards are summed over the joints of the term.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.composing import composed, excess, magnitude, outside, squared

wp.set_module_options({"enable_backward": False})


@wp.func
def joint_position(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint [m, rad]. Isaac Lab: joint_pos."""
    return worlds.joint_q[world, robot.coordinates[joint]]


@wp.func
def measured_joint_position(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint measured by its encoder: position + encoder bias [m, rad]."""
    return joint_position(world, worlds, robot, joint) + robot.encoder_bias[world, joint]


@wp.func
def joint_offset(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Position of a joint relative to its default [m, rad]. mjlab, Isaac Lab: joint_pos_rel."""
    return joint_position(world, worlds, robot, joint) - robot.defaults[joint]


@wp.func
def joint_velocity(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Velocity of a joint [m/s, rad/s]. mjlab: joint_vel_rel. Isaac Lab: joint_vel_rel, joint_vel."""
    return worlds.joint_qd[world, robot.dofs[joint]]


@wp.func
def joint_effort(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    """Force or torque of the actuator on a joint in the last physics step [N, N m]. Isaac Lab: joint_effort."""
    return worlds.drives[world, robot.dofs[joint]]


@composed(magnitude, joint_velocity)
def joint_speed():
    """Magnitude of a joint's velocity [m/s, rad/s]. Isaac Lab: joint_vel_l1."""


@needs(some_ranges=True)
@wp.func
def joint_limit_excess(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, soft_factor: float = 0.95
) -> float:
    """Distance of a joint beyond its soft limits [m, rad], at ``soft_factor`` times the range about its middle; 0 without limits.

    mjlab, Isaac Lab: joint_pos_limits.
    """
    ends = robot.ranges[joint]
    margin = 0.5 * (1.0 - soft_factor) * (ends[1] - ends[0])
    if not wp.isfinite(margin):
        margin = 0.0
    position = joint_position(world, worlds, robot, joint)
    return wp.max(ends[0] + margin - position, 0.0) + wp.max(position - ends[1] + margin, 0.0)


@composed(squared, joint_velocity)
def joint_velocity_squared():
    """Square of a joint's velocity [m^2/s^2, rad^2/s^2]. mjlab, Isaac Lab: joint_vel_l2."""


@composed(squared, excess, joint_speed)
def joint_velocity_excess_squared(limit: float):
    """Square of the excess of a joint's speed over ``limit`` [m^2/s^2, rad^2/s^2].

    mjlab: joint_velocity_hinge_penalty (limit: max_vel).
    """


@composed(squared, joint_effort)
def joint_effort_squared():
    """Square of the actuator's force or torque on a joint [N^2, N^2 m^2].

    mjlab: joint_torques_l2 (which takes the force of the actuator, before its gear). Isaac Lab: joint_torques_l2.
    """


@composed(squared, joint_offset)
def joint_deviation_squared():
    """Square of a joint's distance from its default position [m^2, rad^2]."""


@composed(outside, joint_position)
def joint_out_of_range(bounds: wp.vec2):
    """Whether a joint is below the first or above the second of ``bounds`` [m, rad].

    Isaac Lab: joint_pos_out_of_manual_limit.
    """
