"""Locomotion: further tracking rewards, distances to a commanded place, and posture."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import (
    root_com_velocity,
    root_origin_velocity,
    root_rotation_of,
    root_turning,
    yaw_quaternion,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.commands import command_speed, command_vector
from worker.tasks.terms.composing import (
    composed,
    likeness,
    likeness_of_mean,
    nearness,
    planar_length,
    planar_squared,
    squared,
)
from worker.tasks.terms.joints import joint_deviation_squared
from worker.tasks.terms.more.joints import joint_deviation
from worker.tasks.terms.root import root_linear_velocity
from worker.tasks.terms.tolerances import ToleranceArrays, posture_within

wp.set_module_options({"enable_backward": False})


@wp.func
def track_planar_velocity_by_heading(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """As :func:`track_planar_velocity`, with forward and left as seen from above, independent of the root's tilt [m^2/s^2].

    Isaac Lab: track_lin_vel_xy_yaw_frame_exp.
    """
    yaw = yaw_quaternion(root_rotation_of(worlds, robot, world))
    error = wp.quat_rotate_inv(yaw, root_com_velocity(worlds, robot, world)) - command_vector(world, episodes, command)
    return likeness(planar_squared(error), std)


@wp.func
def track_turning_velocity_in_world(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e^2 / std^2), e the error of the root's angular velocity about the vertical [rad/s].

    Isaac Lab: track_ang_vel_z_world_exp.
    """
    return likeness(squared(root_turning(worlds, robot, world)[2] - episodes.memory[world, command + 2]), std)


@wp.func
def velocity_along_command(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, bodies: BodyArrays, command: int
) -> float:
    """Velocity of the root's origin in the commanded direction, forward and left, at most the commanded speed [m/s]; 0 for a command to
    stand.
    """
    commanded = wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1])
    velocity = root_linear_velocity(world, worlds, robot, bodies)
    along = wp.dot(wp.vec2(velocity[0], velocity[1]), wp.normalize(commanded))
    return wp.min(along, wp.length(commanded))


@composed(likeness_of_mean, joint_deviation_squared, sum_over="robot.defaults")
def posture(std: float):
    """exp(-mean of e^2 / std^2) over all joints of the robot, e a joint's distance from its default [rad, m].

    mjlab: posture (with one std).
    """


@wp.func
def tolerant_posture(world: int, worlds: WorldArrays, robot: RobotArrays, tolerances: ToleranceArrays) -> float:
    """exp(-mean of e^2 / s^2) over the joints of ``tolerances``, e the distance of each from its default and s its ``standing`` [rad, m].

    mjlab: posture.
    """
    return posture_within(worlds, robot, tolerances.columns, tolerances.standing, world)


@wp.func
def deviation_when_standing(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    joint: int,
    command: int,
    threshold: float = 0.06,
) -> float:
    """Distance of a joint from its default [m, rad] while the command's planar speed is below ``threshold`` [m/s], else 0.

    Isaac Lab: stand_still_joint_deviation_l1.
    """
    if planar_length(command_vector(world, episodes, command)) >= threshold:
        return 0.0
    return joint_deviation(world, worlds, robot, joint)


@wp.func
def motion_when_standing(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    command: int,
    threshold: float = 0.1,
) -> float:
    """Squared speed of the root's origin [m^2/s^2] + its squared angular velocity [rad^2/s^2] while the command asks for less than ``threshold``."""
    if command_speed(world, episodes, command) >= threshold:
        return 0.0
    angular = root_turning(worlds, robot, world)
    return wp.length_sq(root_origin_velocity(worlds, robot, bodies, world)) + wp.length_sq(angular)


@wp.func
def heading_error(world: int, episodes: EpisodeArrays, command: int) -> float:
    """Angle to the heading of a planar pose command [rad]. Isaac Lab: heading_command_error_abs (of navigation)."""
    return wp.abs(episodes.memory[world, command + 2])


@wp.func
def distance_left(world: int, episodes: EpisodeArrays, command: int) -> float:
    """Remaining distance to the place of a planar pose command [m]."""
    return wp.length(wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1]))


@composed(nearness, distance_left)
def near_place(std: float):
    """1 - tanh(d / std), d the remaining distance to the place of a planar pose command [m].

    Isaac Lab: position_command_error_tanh (of navigation).
    """
