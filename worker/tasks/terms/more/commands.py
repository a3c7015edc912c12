"""Commands: further draws and observations."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import (
    quaternion_from_angles,
    root_position_of,
    root_rotation_of,
    set_root_velocity,
    wrapped_angle,
    yaw_of,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.commands import velocity_command
from worker.tasks.terms.placing import between

wp.set_module_options({"enable_backward": False})


TARGET = wp.constant(3)
"""First of three hidden columns of :func:`planar_pose_command`, counted from the command's first."""


@needs(command=3)
@wp.func
def moving_velocity_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    command: int,
    stream: wp.uint32,
    forward: wp.vec2,
    left: wp.vec2,
    turn: wp.vec2,
    moving_share: float,
    standing_share: float = 0.0,
):
    """Draw velocities as :func:`velocity_command`, and start ``moving_share`` of all episodes at these velocities; 3 numbers.

    In those the root's origin starts with the commanded velocity and the root with the commanded turning velocity, in its own frame.

    mjlab: UniformVelocityCommand (init_velocity_prob).
    """
    velocity_command(world, episodes, command, stream, forward, left, turn, standing_share)
    if episodes.ages[world] == 0 and between(stream, 0, wp.vec2(0.0, 1.0)) < moving_share:
        rotation = root_rotation_of(worlds, robot, world)
        linear = wp.vec3(episodes.memory[world, command], episodes.memory[world, command + 1], 0.0)
        angular = wp.vec3(0.0, 0.0, episodes.memory[world, command + 2])
        set_root_velocity(
            worlds, robot, bodies, world, wp.quat_rotate(rotation, linear), wp.quat_rotate(rotation, angular)
        )


@needs(command=1)
@wp.func
def number_command(world: int, episodes: EpisodeArrays, command: int, stream: wp.uint32, bounds: wp.vec2):
    """Draw one number evenly from ``bounds``, such as a height to stand at."""
    episodes.memory[world, command] = wp.randf(stream, bounds[0], bounds[1])


@needs(command=3)
@wp.func
def position_command(
    world: int, episodes: EpisodeArrays, command: int, stream: wp.uint32, x: wp.vec2, y: wp.vec2, z: wp.vec2
):
    """Draw a point evenly from a box [m]; 3 numbers. The terms that read it define its frame.

    mjlab: LiftingCommand (the target alone, in the world frame). Isaac Lab: UniformPoseCommand (the position alone).
    """
    episodes.memory[world, command] = wp.randf(stream, x[0], x[1])
    episodes.memory[world, command + 1] = wp.randf(stream, y[0], y[1])
    episodes.memory[world, command + 2] = wp.randf(stream, z[0], z[1])


@needs(command=7)
@wp.func
def pose_command(
    world: int,
    episodes: EpisodeArrays,
    command: int,
    stream: wp.uint32,
    x: wp.vec2,
    y: wp.vec2,
    z: wp.vec2,
    roll: wp.vec2,
    pitch: wp.vec2,
    yaw: wp.vec2,
):
    """Draw a pose in the root's frame: a point evenly from a box [m], roll, pitch and yaw [rad]; 7 numbers, position and quaternion xyzw.

    Isaac Lab: UniformPoseCommand.
    """
    episodes.memory[world, command] = wp.randf(stream, x[0], x[1])
    episodes.memory[world, command + 1] = wp.randf(stream, y[0], y[1])
    episodes.memory[world, command + 2] = wp.randf(stream, z[0], z[1])
    about_x = wp.randf(stream, roll[0], roll[1])
    about_y = wp.randf(stream, pitch[0], pitch[1])
    about_z = wp.randf(stream, yaw[0], yaw[1])
    rotation = quaternion_from_angles(about_x, about_y, about_z)
    for axis in range(4):
        episodes.memory[world, command + 3 + axis] = rotation[axis]


@needs(command=3, hidden=3)
@wp.func
def planar_pose_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    command: int,
    stream: wp.uint32,
    x: wp.vec2,
    y: wp.vec2,
    heading: wp.vec2,
):
    """Draw a place on the ground around the robot's start [m] and a heading there [rad]; 3 numbers and 3 hidden ones.

    The numbers are the distances forward and left to the place [m] and the left turn to the heading [rad], from the robot's present pose.
    Declare it with ``update=Term(terms.steer_planar_pose_command)``, which recomputes them in every step.

    Isaac Lab: UniformPose2dCommand.
    """
    start = wp.transform_get_translation(robot.start)
    episodes.memory[world, command + TARGET] = start[0] + wp.randf(stream, x[0], x[1])
    episodes.memory[world, command + TARGET + 1] = start[1] + wp.randf(stream, y[0], y[1])
    episodes.memory[world, command + TARGET + 2] = wp.randf(stream, heading[0], heading[1])
    steer_planar_pose_command(world, worlds, episodes, robot, command)


@needs(command=3, hidden=3)
@wp.func
def steer_planar_pose_command(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
):
    """Recompute place and heading of :func:`planar_pose_command` in the robot's present frame: forward, left [m], left turn [rad].

    Isaac Lab: UniformPose2dCommand (its update).
    """
    position = root_position_of(worlds, robot, world)
    yaw = yaw_of(root_rotation_of(worlds, robot, world))
    along_x = episodes.memory[world, command + TARGET] - position[0]
    along_y = episodes.memory[world, command + TARGET + 1] - position[1]
    episodes.memory[world, command] = wp.cos(yaw) * along_x + wp.sin(yaw) * along_y
    episodes.memory[world, command + 1] = wp.cos(yaw) * along_y - wp.sin(yaw) * along_x
    episodes.memory[world, command + 2] = wrapped_angle(episodes.memory[world, command + TARGET + 2] - yaw)


@needs(numbers=True)
@wp.func
def command_number(world: int, episodes: EpisodeArrays, command: int, index: int) -> float:
    """Number ``index`` of a command, by default each number that the policy observes [unit of the command].

    mjlab, Isaac Lab: generated_commands.
    """
    return episodes.memory[world, command + index]


@needs(command=7)
@wp.func
def command_rotation(world: int, episodes: EpisodeArrays, command: int) -> wp.quat:
    """The rotation of a pose command, its numbers 3 to 6, a quaternion xyzw.

    Isaac Lab: generated_commands (its last four numbers, wxyz).
    """
    return wp.quat(
        episodes.memory[world, command + 3],
        episodes.memory[world, command + 4],
        episodes.memory[world, command + 5],
        episodes.memory[world, command + 6],
    )
