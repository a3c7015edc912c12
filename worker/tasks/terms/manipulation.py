"""Manipulation: a hand, an object and its target.

The hand is the first column of a frame sensor in the world frame (``Frames(sites="...")`` or ``Frames(bodies="...")``); the object
is the root of a further robot (``other="cube"``). A target is the first three numbers of a command: in the world frame, unless the
name of the term says ``command`` (a pose in the root's frame, as :func:`pose_command` draws it).
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import root_position_of, root_rotation_of
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.commands import command_vector
from worker.tasks.terms.composing import below, composed, flag, likeness, squared

wp.set_module_options({"enable_backward": False})


@wp.func
def hand_to_object(
    world: int, worlds: WorldArrays, robot: RobotArrays, other: RobotArrays, hand: FrameArrays
) -> wp.vec3:
    """Vector from the hand to an object, along the axes of the robot's root [m]. mjlab: ee_to_object_distance."""
    way = root_position_of(worlds, other, world) - hand.positions[world, 0]
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def object_to_target(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, other: RobotArrays, command: int
) -> wp.vec3:
    """Vector from an object to its target, along the axes of the robot's root [m]. mjlab: object_to_goal_distance."""
    way = command_vector(world, episodes, command) - root_position_of(worlds, other, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def hand_object_distance(world: int, worlds: WorldArrays, robot: RobotArrays, hand: FrameArrays) -> float:
    """Distance between the hand and an object, which ``robot=`` names [m]."""
    return wp.length(root_position_of(worlds, robot, world) - hand.positions[world, 0])


@wp.func
def object_target_distance(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, command: int
) -> float:
    """Distance of an object, which ``robot=`` names, to its target [m]. mjlab: position_error (of LiftingCommand)."""
    return wp.length(command_vector(world, episodes, command) - root_position_of(worlds, robot, world))


@composed(likeness, squared, hand_object_distance)
def reach_object(std: float):
    """exp(-d^2 / std^2), d the distance between the hand and an object, which ``robot=`` names [m]."""


@composed(likeness, squared, object_target_distance)
def bring_object(std: float):
    """exp(-d^2 / std^2), d the distance between an object, which ``robot=`` names, and its target [m].

    mjlab: bring_object_reward.
    """


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

    mjlab: staged_position_reward.
    """
    reached = reach_object(world, worlds, robot, hand, reaching_std)
    return reached * (1.0 + bring_object(world, worlds, episodes, robot, command, bringing_std))


@composed(flag, below, object_target_distance)
def object_at_target(distance: float):
    """1 where an object, which ``robot=`` names, is closer to its target than ``distance`` [m], else 0.

    mjlab: at_goal (of LiftingCommand).
    """


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

    mjlab: episode_success (of LiftingCommand, which forgets it when a target is drawn).
    """
    now = object_at_target(world, worlds, episodes, robot, command, distance)
    episodes.memory[world, memory] = wp.max(episodes.memory[world, memory], now)
    return episodes.memory[world, memory]
