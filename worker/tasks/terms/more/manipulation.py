"""Manipulation: further measurements of a hand, an object and its target, and rewards."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import (
    quaternion_error,
    root_com_velocity,
    root_pose,
    root_position_of,
    root_rotation_of,
    unique_quaternion,
)
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.commands import command_vector
from worker.tasks.terms.composing import above, composed, flag, nearness
from worker.tasks.terms.manipulation import hand_object_distance
from worker.tasks.terms.more.commands import command_rotation
from worker.tasks.terms.root import root_height

wp.set_module_options({"enable_backward": False})


@wp.func
def commanded_point(
    worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, world: int, command: int
) -> wp.vec3:
    """The position of a pose command, in the world frame [m]."""
    return wp.transform_point(root_pose(worlds, robot, world), command_vector(world, episodes, command))


@wp.func
def object_position_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays) -> wp.vec3:
    """Position of an object in the robot's root frame [m]. Isaac Lab: object_position_in_robot_root_frame."""
    way = root_position_of(worlds, other, world) - root_position_of(worlds, robot, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def object_orientation_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays) -> wp.quat:
    """Rotation from an object to the robot's root frame, a quaternion xyzw whose w is not negative."""
    root = root_rotation_of(worlds, robot, world)
    return unique_quaternion(wp.quat_inverse(root) * root_rotation_of(worlds, other, world))


@wp.func
def object_velocity_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays) -> wp.vec3:
    """Velocity of an object's centre of mass relative to the world, along the axes of the robot's root [m/s]."""
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), root_com_velocity(worlds, other, world))


@wp.func
def target_in_hand(world: int, episodes: EpisodeArrays, hand: FrameArrays, command: int) -> wp.vec3:
    """Position of the target in the hand's frame [m]. mjlab: target_position."""
    way = command_vector(world, episodes, command) - hand.positions[world, 0]
    return wp.quat_rotate_inv(hand.rotations[world, 0], way)


@wp.func
def target_in_root(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
) -> wp.vec3:
    """Position of the target in the robot's root frame [m]."""
    way = command_vector(world, episodes, command) - root_position_of(worlds, robot, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@composed(nearness, hand_object_distance)
def near_object(std: float):
    """1 - tanh(d / std), d the distance between the hand and an object, which ``robot=`` names [m].

    Isaac Lab: object_ee_distance.
    """


@composed(flag, above, root_height)
def object_lifted(height: float):
    """1 where an object, which ``robot=`` names, is above ``height`` [m], else 0. Isaac Lab: object_is_lifted."""


@wp.func
def lifted_object_near_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    other: RobotArrays,
    command: int,
    std: float,
    height: float,
) -> float:
    """1 - tanh(d / std) where an object is above ``height`` [m], else 0; d its distance from the commanded position [m].

    Isaac Lab: object_goal_distance.
    """
    position = root_position_of(worlds, other, world)
    if position[2] <= height:
        return 0.0
    return nearness(wp.length(commanded_point(worlds, episodes, robot, world, command) - position), std)


@wp.func
def object_reached_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    other: RobotArrays,
    command: int,
    distance: float,
) -> bool:
    """Whether an object is closer to the commanded position than ``distance`` [m]. Isaac Lab: object_reached_goal."""
    way = commanded_point(worlds, episodes, robot, world, command) - root_position_of(worlds, other, world)
    return wp.length(way) < distance


@wp.func
def hand_command_distance(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, hand: FrameArrays, command: int
) -> float:
    """Distance between the hand and the commanded position [m]. Isaac Lab: position_command_error."""
    return wp.length(commanded_point(worlds, episodes, robot, world, command) - hand.positions[world, 0])


@composed(nearness, hand_command_distance)
def hand_near_command(std: float):
    """1 - tanh(d / std), d the distance between the hand and the commanded position [m].

    Isaac Lab: position_command_error_tanh.
    """


@wp.func
def hand_command_turn(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, hand: FrameArrays, command: int
) -> float:
    """Angle between the hand and the commanded rotation, in [0, pi] [rad]. Isaac Lab: orientation_command_error."""
    commanded = root_rotation_of(worlds, robot, world) * command_rotation(world, episodes, command)
    return quaternion_error(commanded, hand.rotations[world, 0])


@wp.func
def object_command_turn(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, other: RobotArrays, command: int
) -> float:
    """Angle between an object and the commanded rotation, in [0, pi] [rad].

    Isaac Lab: track_orientation_inv_l2 (of in-hand manipulation, which takes the inverse of the angle).
    """
    commanded = root_rotation_of(worlds, robot, world) * command_rotation(world, episodes, command)
    return quaternion_error(commanded, root_rotation_of(worlds, other, world))
