"""Locomotion: tracking of a velocity command, distance to a commanded place, and posture."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.commands import command_vector
from worker.tasks.terms.composing import composed, likeness, planar_length, planar_squared, squared
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

    mjlab: track_linear_velocity.
    """
    commanded = command_vector(world, episodes, command)
    error = root_linear_velocity(world, worlds, robot, bodies) - wp.vec3(commanded[0], commanded[1], 0.0)
    return likeness(wp.length_sq(error), std)


@wp.func
def track_angular_velocity(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e / std^2), e the square of the distance between the root's angular velocity in its own frame and (0, 0, turn) [rad^2/s^2].

    mjlab: track_angular_velocity.
    """
    turn = wp.vec3(0.0, 0.0, episodes.memory[world, command + 2])
    return likeness(wp.length_sq(root_angular_velocity(world, worlds, robot) - turn), std)


@wp.func
def track_planar_velocity(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-e / std^2), e the square of the error forward and left of the root's centre of mass, in its own frame [m^2/s^2].

    Isaac Lab: track_lin_vel_xy_exp.
    """
    error = root_com_linear_velocity(world, worlds, robot) - command_vector(world, episodes, command)
    return likeness(planar_squared(error), std)


@wp.func
def turning_velocity_error(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
) -> float:
    """Magnitude of the error of the root's angular velocity about its own z axis [rad/s].

    mjlab, Isaac Lab: error_vel_yaw (of UniformVelocityCommand).
    """
    return wp.abs(root_angular_velocity(world, worlds, robot)[2] - episodes.memory[world, command + 2])


@composed(likeness, squared, turning_velocity_error)
def track_turning_velocity(std: float):
    """exp(-e^2 / std^2), e the error of the root's angular velocity about its own z axis [rad/s].

    Isaac Lab: track_ang_vel_z_exp.
    """


@wp.func
def planar_velocity_error(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, bodies: BodyArrays, command: int
) -> float:
    """Length of the error forward and left of the velocity of the root's origin, in its own frame [m/s].

    mjlab, Isaac Lab: error_vel_xy (of UniformVelocityCommand).
    """
    return planar_length(root_linear_velocity(world, worlds, robot, bodies) - command_vector(world, episodes, command))
