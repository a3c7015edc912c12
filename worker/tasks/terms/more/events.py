"""Events: further resets."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import random_quaternion
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.placing import NONE, between, place_root, set_joint, within_limits

wp.set_module_options({"enable_backward": False})


@needs(free_root=True)
@wp.func
def reset_root_any_way_up(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    stream: wp.uint32,
    x: wp.vec2 = NONE,
    y: wp.vec2 = NONE,
    z: wp.vec2 = NONE,
):
    """Place a free root at rest at its start + offsets [m], with a uniformly random rotation.

    Isaac Lab: reset_root_state_with_random_orientation.
    """
    offset = wp.vec3(between(stream, 0, x), between(stream, 1, y), between(stream, 2, z))
    nothing = wp.vec3(0.0, 0.0, 0.0)
    turn = random_quaternion(wp.rand_init(int(stream), 3))
    place_root(world, worlds, robot, bodies, nothing, offset, turn, nothing, nothing)


@wp.func
def reset_joints_by_scale(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    joint: int,
    stream: wp.uint32,
    position: wp.vec2,
    velocity: wp.vec2 = NONE,
    soft_factor: float = 1.0,
):
    """Put a joint at its default times a factor from ``position``, with a velocity from ``velocity`` [m/s, rad/s].

    The position stays within ``soft_factor`` times the joint's range about its middle.

    Isaac Lab: reset_joints_by_scale (which scales the default velocity, 0 as a rule).
    """
    place = within_limits(robot, joint, robot.defaults[joint] * between(stream, 0, position), soft_factor)
    set_joint(worlds, robot, world, joint, place, between(stream, 1, velocity))


@wp.func
def reset_joints_in_range(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    joint: int,
    stream: wp.uint32,
    position: wp.vec2,
    velocity: wp.vec2 = NONE,
):
    """Put a joint at a position from ``position`` [m, rad], with a velocity from ``velocity`` [m/s, rad/s].

    Isaac Lab: reset_joints_within_limits_range.
    """
    set_joint(worlds, robot, world, joint, between(stream, 0, position), between(stream, 1, velocity))


@needs(some_ranges=True)
@wp.func
def reset_joints_between_limits(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    joint: int,
    stream: wp.uint32,
    soft_factor: float = 1.0,
    velocity: wp.vec2 = NONE,
):
    """Put a joint uniformly within ``soft_factor`` times its range about its middle; a joint without limits goes to its default.

    Isaac Lab: reset_joints_within_limits_range (with scale).
    """
    ends = robot.ranges[joint]
    place = robot.defaults[joint]
    if wp.isfinite(ends[1] - ends[0]):
        half = 0.5 * soft_factor * (ends[1] - ends[0])
        place = 0.5 * (ends[0] + ends[1]) + between(stream, 0, wp.vec2(-half, half))
    set_joint(worlds, robot, world, joint, place, between(stream, 1, velocity))
