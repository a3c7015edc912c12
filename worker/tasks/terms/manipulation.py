"""Manipulation: a hand, an object and its target.

The hand is the first column of a frame sensor in the world frame (``Frames(sites="...")`` or ``Frames(bodies="...")``); the object
is the root of a further robot (``other="cube"``). A target is the first three numbers of a command: in the world frame, unless the
name of the term says ``command`` (a pose in the root's frame, as :func:`pose_command` draws it).
"""

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
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.commands import command_rotation, command_vector

wp.set_module_options({"enable_backward": False})


@wp.func
def near(distance: float, std: float) -> float:
    """1 - tanh(distance / std): 1 there, 0 far away."""
    return 1.0 - wp.tanh(distance / std)


@wp.func
def commanded_point(
    worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, world: int, command: int
) -> wp.vec3:
    """The position of a pose command, in the world frame [m]."""
    return wp.transform_point(root_pose(worlds, robot, world), command_vector(world, episodes, command))


@wp.func
def object_position_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays) -> wp.vec3:
    """Position of an object in the robot's root frame [m].

    mjlab: -. Isaac Lab: object_position_in_robot_root_frame.
    """
    way = root_position_of(worlds, other, world) - root_position_of(worlds, robot, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def object_orientation_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays) -> wp.quat:
    """Rotation from an object to the robot's root frame, a quaternion xyzw whose w is not negative.

    mjlab: -. Isaac Lab: -.
    """
    root = root_rotation_of(worlds, robot, world)
    return unique_quaternion(wp.quat_inverse(root) * root_rotation_of(worlds, other, world))


@wp.func
def object_velocity_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays) -> wp.vec3:
    """Velocity of an object's centre of mass relative to the world, along the axes of the robot's root [m/s].

    mjlab: -. Isaac Lab: -.
    """
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), root_com_velocity(worlds, other, world))


@wp.func
def hand_to_object(
    world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays, hand: FrameArrays
) -> wp.vec3:
    """Vector from the hand to an object, along the axes of the robot's root [m].

    mjlab: ee_to_object_distance. Isaac Lab: -.
    """
    way = root_position_of(worlds, other, world) - hand.positions[world, 0]
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def object_to_target(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, other: RobotArrays, command: int
) -> wp.vec3:
    """Vector from an object to its target, along the axes of the robot's root [m].

    mjlab: object_to_goal_distance. Isaac Lab: -.
    """
    way = command_vector(world, episodes, command) - root_position_of(worlds, other, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def target_in_hand(world: int, episodes: EpisodeArrays, hand: FrameArrays, command: int) -> wp.vec3:
    """Position of the target in the hand's frame [m].

    mjlab: target_position. Isaac Lab: -.
    """
    way = command_vector(world, episodes, command) - hand.positions[world, 0]
    return wp.quat_rotate_inv(hand.rotations[world, 0], way)


@wp.func
def target_in_root(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
) -> wp.vec3:
    """Position of the target in the robot's root frame [m].

    mjlab: -. Isaac Lab: -.
    """
    way = command_vector(world, episodes, command) - root_position_of(worlds, robot, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def hand_object_distance(world: int, worlds: WorldArrays, robot: RobotArrays, hand: FrameArrays) -> float:
    """Distance between the hand and an object, which ``robot=`` names [m].

    mjlab: -. Isaac Lab: -.
    """
    return wp.length(root_position_of(worlds, robot, world) - hand.positions[world, 0])


@wp.func
def object_target_distance(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
) -> float:
    """Distance between an object, which ``robot=`` names, and its target [m].

    mjlab: position_error (of LiftingCommand). Isaac Lab: -.
    """
    return wp.length(command_vector(world, episodes, command) - root_position_of(worlds, robot, world))


@wp.func
def reach_object(world: int, worlds: WorldArrays, robot: RobotArrays, hand: FrameArrays, std: float) -> float:
    """exp(-d^2 / std^2), d the distance between the hand and an object, which ``robot=`` names [m].

    mjlab: -. Isaac Lab: -.
    """
    distance = hand_object_distance(world, worlds, robot, hand)
    return wp.exp(-distance * distance / (std * std))


@wp.func
def near_object(world: int, worlds: WorldArrays, robot: RobotArrays, hand: FrameArrays, std: float) -> float:
    """1 - tanh(d / std), d the distance between the hand and an object, which ``robot=`` names [m].

    mjlab: -. Isaac Lab: object_ee_distance.
    """
    return near(hand_object_distance(world, worlds, robot, hand), std)


@wp.func
def bring_object(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, std: float
) -> float:
    """exp(-d^2 / std^2), d the distance between an object, which ``robot=`` names, and its target [m].

    mjlab: bring_object_reward. Isaac Lab: -.
    """
    distance = object_target_distance(world, worlds, episodes, robot, command)
    return wp.exp(-distance * distance / (std * std))


@wp.func
def reach_and_bring_object(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    hand: FrameArrays,
    command: int,
    reaching_std: float,
    bringing_std: float,
) -> float:
    """r (1 + b), r as :func:`reach_object` and b as :func:`bring_object`, in [0, 2]: bringing counts only near the hand.

    mjlab: staged_position_reward. Isaac Lab: -.
    """
    reached = reach_object(world, worlds, robot, hand, reaching_std)
    return reached * (1.0 + bring_object(world, worlds, episodes, robot, command, bringing_std))


@wp.func
def object_lifted(world: int, worlds: WorldArrays, robot: RobotArrays, height: float) -> float:
    """1 where an object, which ``robot=`` names, is above ``height`` [m], else 0.

    mjlab: -. Isaac Lab: object_is_lifted.
    """
    return wp.where(root_position_of(worlds, robot, world)[2] > height, 1.0, 0.0)


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

    mjlab: -. Isaac Lab: object_goal_distance.
    """
    position = root_position_of(worlds, other, world)
    if position[2] <= height:
        return 0.0
    return near(wp.length(commanded_point(worlds, episodes, robot, world, command) - position), std)


@wp.func
def object_at_target(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int, distance: float
) -> float:
    """1 where an object, which ``robot=`` names, is closer to its target than ``distance`` [m], else 0.

    mjlab: at_goal (of LiftingCommand). Isaac Lab: -.
    """
    return wp.where(object_target_distance(world, worlds, episodes, robot, command) < distance, 1.0, 0.0)


@needs(memory=1)
@wp.func
def object_was_at_target(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    command: int,
    memory: int,
    distance: float,
) -> float:
    """1 once an object, which ``robot=`` names, was closer to its target than ``distance`` [m].

    It stays 1 until the episode ends, even if a new target is drawn.

    mjlab: episode_success (of LiftingCommand, which forgets it when a target is drawn). Isaac Lab: -.
    """
    now = object_at_target(world, worlds, episodes, robot, command, distance)
    episodes.memory[world, memory] = wp.max(episodes.memory[world, memory], now)
    return episodes.memory[world, memory]


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
    """Whether an object is closer to the commanded position than ``distance`` [m].

    mjlab: -. Isaac Lab: object_reached_goal.
    """
    way = commanded_point(worlds, episodes, robot, world, command) - root_position_of(worlds, other, world)
    return wp.length(way) < distance


@wp.func
def hand_command_distance(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, hand: FrameArrays, command: int
) -> float:
    """Distance between the hand and the commanded position [m].

    mjlab: -. Isaac Lab: position_command_error.
    """
    return wp.length(commanded_point(worlds, episodes, robot, world, command) - hand.positions[world, 0])


@wp.func
def hand_near_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    hand: FrameArrays,
    command: int,
    std: float,
) -> float:
    """1 - tanh(d / std), d the distance between the hand and the commanded position [m].

    mjlab: -. Isaac Lab: position_command_error_tanh.
    """
    return near(hand_command_distance(world, worlds, episodes, robot, hand, command), std)


@wp.func
def hand_command_turn(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, hand: FrameArrays, command: int
) -> float:
    """Angle between the hand and the commanded rotation, in [0, pi] [rad].

    mjlab: -. Isaac Lab: orientation_command_error.
    """
    wanted = root_rotation_of(worlds, robot, world) * command_rotation(world, episodes, command)
    return quaternion_error(wanted, hand.rotations[world, 0])


@wp.func
def object_command_turn(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, other: RobotArrays, command: int
) -> float:
    """Angle between an object and the commanded rotation, in [0, pi] [rad].

    mjlab: -. Isaac Lab: track_orientation_inv_l2 (of in-hand manipulation, which takes the inverse of the angle).
    """
    wanted = root_rotation_of(worlds, robot, world) * command_rotation(world, episodes, command)
    return quaternion_error(wanted, root_rotation_of(worlds, other, world))
