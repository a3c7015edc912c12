"""Locomotion: tracking of a velocity command, distance to a commanded place, and posture."""

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
from worker.tasks.terms.joints import joint_deviation, joint_deviation_squared
from worker.tasks.terms.root import root_angular_velocity, root_com_linear_velocity, root_linear_velocity

wp.set_module_options({"enable_backward": False})


@wp.func
def track_linear_velocity(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    command: int,
    std: float,
) -> float:
    """exp(-e / std^2), e the square of the distance between the root's velocity in its own frame and (forward, left, 0) [m^2/s^2].

    mjlab: track_linear_velocity. Isaac Lab: -.
    """
    asked = command_vector(world, episodes, command)
    error = wp.length_sq(root_linear_velocity(world, worlds, robot, bodies) - wp.vec3(asked[0], asked[1], 0.0))
    return wp.exp(-error / (std * std))


@wp.func
def track_angular_velocity(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e / std^2), e the square of the distance between the root's angular velocity in its own frame and (0, 0, turn) [rad^2/s^2].

    mjlab: track_angular_velocity. Isaac Lab: -.
    """
    turn = episodes.memory[world, command + 2]
    error = wp.length_sq(root_angular_velocity(world, worlds, robot) - wp.vec3(0.0, 0.0, turn))
    return wp.exp(-error / (std * std))


@wp.func
def track_planar_velocity(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e / std^2), e the square of the error forward and left of the root's centre of mass, in its own frame [m^2/s^2].

    mjlab: -. Isaac Lab: track_lin_vel_xy_exp.
    """
    error = root_com_linear_velocity(world, worlds, robot) - command_vector(world, episodes, command)
    return wp.exp(-(error[0] * error[0] + error[1] * error[1]) / (std * std))


@wp.func
def track_planar_velocity_by_heading(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """As :func:`track_planar_velocity`, with forward and left as seen from above, independent of the root's tilt [m^2/s^2].

    mjlab: -. Isaac Lab: track_lin_vel_xy_yaw_frame_exp.
    """
    yaw = yaw_quaternion(root_rotation_of(worlds, robot, world))
    error = wp.quat_rotate_inv(yaw, root_com_velocity(worlds, robot, world)) - command_vector(world, episodes, command)
    return wp.exp(-(error[0] * error[0] + error[1] * error[1]) / (std * std))


@wp.func
def track_turning_velocity(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e^2 / std^2), e the error of the root's angular velocity about its own z axis [rad/s].

    mjlab: -. Isaac Lab: track_ang_vel_z_exp.
    """
    error = root_angular_velocity(world, worlds, robot)[2] - episodes.memory[world, command + 2]
    return wp.exp(-error * error / (std * std))


@wp.func
def track_turning_velocity_in_world(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e^2 / std^2), e the error of the root's angular velocity about the vertical [rad/s].

    mjlab: -. Isaac Lab: track_ang_vel_z_world_exp.
    """
    error = root_turning(worlds, robot, world)[2] - episodes.memory[world, command + 2]
    return wp.exp(-error * error / (std * std))


@wp.func
def planar_velocity_error(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, bodies: BodyArrays, command: int
) -> float:
    """Length of the error forward and left of the velocity of the root's origin, in its own frame [m/s].

    mjlab: error_vel_xy (of UniformVelocityCommand). Isaac Lab: error_vel_xy (of UniformVelocityCommand).
    """
    error = root_linear_velocity(world, worlds, robot, bodies) - command_vector(world, episodes, command)
    return wp.length(wp.vec2(error[0], error[1]))


@wp.func
def turning_velocity_error(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
) -> float:
    """Magnitude of the error of the root's angular velocity about its own z axis [rad/s].

    mjlab: error_vel_yaw (of UniformVelocityCommand). Isaac Lab: error_vel_yaw (of UniformVelocityCommand).
    """
    return wp.abs(root_angular_velocity(world, worlds, robot)[2] - episodes.memory[world, command + 2])


@wp.func
def velocity_along_command(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, bodies: BodyArrays, command: int
) -> float:
    """Velocity of the root's origin in the commanded direction, forward and left, at most the commanded speed [m/s]; 0 for a command to
    stand.

    mjlab: -. Isaac Lab: -.
    """
    asked = wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1])
    velocity = root_linear_velocity(world, worlds, robot, bodies)
    along = wp.dot(wp.vec2(velocity[0], velocity[1]), wp.normalize(asked))
    return wp.min(along, wp.length(asked))


@wp.func
def posture(world: int, worlds: WorldArrays, robot: RobotArrays, std: float) -> float:
    """exp(-mean of e^2 / std^2) over all joints of the robot, e a joint's distance from its default [rad, m].

    mjlab: posture (with one std). Isaac Lab: -.
    """
    total = float(0.0)
    for joint in range(robot.defaults.shape[0]):
        total += joint_deviation_squared(world, worlds, robot, joint)
    return wp.exp(-total / (float(robot.defaults.shape[0]) * std * std))


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

    mjlab: -. Isaac Lab: stand_still_joint_deviation_l1.
    """
    asked = command_vector(world, episodes, command)
    if wp.length(wp.vec2(asked[0], asked[1])) >= threshold:
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
    """Squared speed of the root's origin [m^2/s^2] + its squared angular velocity [rad^2/s^2] while the command asks for less than ``threshold``.

    mjlab: -. Isaac Lab: -.
    """
    if command_speed(world, episodes, command) >= threshold:
        return 0.0
    angular = root_turning(worlds, robot, world)
    return wp.length_sq(root_origin_velocity(worlds, robot, bodies, world)) + wp.length_sq(angular)


@wp.func
def heading_error(world: int, episodes: EpisodeArrays, command: int) -> float:
    """Remaining angle to the heading of a planar pose command [rad].

    mjlab: -. Isaac Lab: heading_command_error_abs (of navigation).
    """
    return wp.abs(episodes.memory[world, command + 2])


@wp.func
def distance_left(world: int, episodes: EpisodeArrays, command: int) -> float:
    """Remaining distance to the place of a planar pose command [m].

    mjlab: -. Isaac Lab: -.
    """
    return wp.length(wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1]))


@wp.func
def near_place(world: int, episodes: EpisodeArrays, command: int, std: float) -> float:
    """1 - tanh(d / std), d the remaining distance to the place of a planar pose command [m].

    mjlab: -. Isaac Lab: position_command_error_tanh (of navigation).
    """
    return 1.0 - wp.tanh(distance_left(world, episodes, command) / std)
