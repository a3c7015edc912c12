"""One of several objects: a selection names them, and a command chooses one for each world.

The selection is a sensor, ``ObjectSelection("cube_*")``. The hand and the target are as for manipulation; the target is in the world frame.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import quaternion_from_angles, root_position_of, set_root_pose
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.selection import SelectionArrays, chosen_one, object_at
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms import manipulation
from worker.tasks.terms.composing import composed
from worker.tasks.terms.root import root_height

wp.set_module_options({"enable_backward": False})


TRIES = wp.constant(16)
"""Number of draws of an object's place before it is put above the others."""


@wp.func
def _touches_others(
    world: int, worlds: WorldArrays, objects: SelectionArrays, count: int, place: wp.vec3, apart: float
) -> bool:
    """Whether a place is closer than ``apart`` [m], seen from above, to one of the first ``count`` objects."""
    found = bool(False)
    for index in range(count):
        way = root_position_of(worlds, object_at(objects, index), world) - place
        if wp.length(wp.vec2(way[0], way[1])) < apart:
            found = True
    return found


@needs(command=3)
@wp.func
def lift_one_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    objects: SelectionArrays,
    command: int,
    stream: wp.uint32,
    x: wp.vec2,
    y: wp.vec2,
    z: wp.vec2,
    object_x: wp.vec2,
    object_y: wp.vec2,
    object_z: wp.vec2,
    object_yaw: wp.vec2,
    apart: float = 0.0,
):
    """Draw a target in the world frame [m] and the object to bring there, and place all objects at rest elsewhere; 3 numbers.

    Place and yaw of all objects are drawn from the same ranges of the world frame [m, rad], and drawn again if the object is closer than
    ``apart`` to an earlier one, seen from above [m]; after 16 tries it is placed above all others.

    mjlab: MultiCubeLiftingCommand (whose cubes may be put into one another).
    """
    episodes.memory[world, command] = wp.randf(stream, x[0], x[1])
    episodes.memory[world, command + 1] = wp.randf(stream, y[0], y[1])
    episodes.memory[world, command + 2] = wp.randf(stream, z[0], z[1])
    count = objects.coordinates.shape[0]
    chosen = wp.randi(stream, 0, count)
    for index in range(count):
        objects.chosen[world, index] = wp.where(index == chosen, 1.0, 0.0)
        place = wp.vec3(0.0, 0.0, 0.0)
        touching = bool(True)
        for _try in range(TRIES):
            if touching:
                place = wp.vec3(
                    wp.randf(stream, object_x[0], object_x[1]),
                    wp.randf(stream, object_y[0], object_y[1]),
                    wp.randf(stream, object_z[0], object_z[1]),
                )
                touching = _touches_others(world, worlds, objects, index, place, apart)
        if touching:
            place[2] = place[2] + float(index) * (apart + object_z[1] - object_z[0])
        one = object_at(objects, index)
        rotation = quaternion_from_angles(0.0, 0.0, wp.randf(stream, object_yaw[0], object_yaw[1]))
        set_root_pose(worlds, one, world, wp.transform(place, rotation))
        for axis in range(6):
            worlds.joint_qd[world, one.root_dof + axis] = 0.0


@wp.func
def object_is_chosen(world: int, objects: SelectionArrays, index: int) -> float:
    """1 for the chosen object, 0 for the others: a one-hot vector over all objects.

    mjlab: camera_target_cube_mask (which shows it in an image).
    """
    return objects.chosen[world, index]


@needs(columns=("objects",))
@wp.func
def hand_to_each_object(
    world: int, worlds: WorldArrays, robot: RobotArrays, hand: FrameArrays, objects: SelectionArrays, index: int
) -> wp.vec3:
    """Vector from the hand to each object, along the axes of the robot's root [m]."""
    return manipulation.hand_to_object(world, worlds, robot, object_at(objects, index), hand)


@wp.func
def hand_to_chosen_object(
    world: int, worlds: WorldArrays, robot: RobotArrays, hand: FrameArrays, objects: SelectionArrays
) -> wp.vec3:
    """Vector from the hand to the chosen object, along the axes of the robot's root [m]."""
    return manipulation.hand_to_object(world, worlds, robot, chosen_one(objects, world), hand)


@needs(command=3)
@composed(manipulation.object_to_target, other=chosen_one)
def chosen_object_to_target():
    """Vector from the chosen object to its target, along the axes of the robot's root [m]."""


@composed(root_height, robot=chosen_one)
def chosen_object_height():
    """Height of the chosen object above z = 0 [m]."""


@needs(command=3)
@composed(manipulation.object_target_distance, robot=chosen_one)
def chosen_object_target_distance():
    """Distance between the chosen object and its target [m]. mjlab: position_error (of MultiCubeLiftingCommand)."""


@needs(command=3)
@composed(manipulation.bring_object, robot=chosen_one)
def bring_chosen_object():
    """exp(-d^2 / std^2), d the distance between the chosen object and its target [m].

    mjlab: multi_cube_bring_object_reward.
    """


@needs(command=3)
@wp.func
def reach_and_bring_chosen_object(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    hand: FrameArrays,
    objects: SelectionArrays,
    command: int,
    reaching_std: float,
    bringing_std: float,
) -> float:
    """r (1 + b), with r and b of ``reach_and_bring_object`` for the chosen object, in [0, 2]; the others earn nothing.

    mjlab: multi_cube_staged_position_reward.
    """
    return manipulation.reach_and_bring_object(
        world, worlds, episodes, chosen_one(objects, world), hand, command, reaching_std, bringing_std
    )


@needs(command=3)
@composed(manipulation.object_at_target, robot=chosen_one)
def chosen_object_at_target():
    """1 while the chosen object is closer to its target than ``distance`` [m], else 0.

    mjlab: at_goal (of MultiCubeLiftingCommand).
    """


@needs(command=3, memory=1)
@composed(manipulation.object_was_at_target, robot=chosen_one)
def chosen_object_was_at_target():
    """1 once the chosen object was closer to its target than ``distance`` [m], until the episode ends.

    mjlab: episode_success (of MultiCubeLiftingCommand, which forgets it when a target is drawn).
    """
