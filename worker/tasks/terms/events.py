"""Events: resets of a world, pushes, and properties drawn once at startup."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import (
    quaternion_from_angles,
    random_quaternion,
    root_origin_velocity,
    root_turning,
    set_root_velocity,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.sensors.wrench import LASTING_FROM_NOW, WrenchArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.placing import NONE, between, place_root, set_joint, within_limits

wp.set_module_options({"enable_backward": False})


@needs(free_root=True)
@wp.func
def reset_root(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    stream: wp.uint32,
    x: wp.vec2 = NONE,
    y: wp.vec2 = NONE,
    z: wp.vec2 = NONE,
    roll: wp.vec2 = NONE,
    pitch: wp.vec2 = NONE,
    yaw: wp.vec2 = NONE,
    velocity_x: wp.vec2 = NONE,
    velocity_y: wp.vec2 = NONE,
    velocity_z: wp.vec2 = NONE,
    turning_x: wp.vec2 = NONE,
    turning_y: wp.vec2 = NONE,
    turning_z: wp.vec2 = NONE,
):
    """Place a free root: its start + offsets drawn evenly from ranges.

    ``x``, ``y``, ``z`` are along the world's axes [m]; ``roll``, ``pitch``, ``yaw`` turn the root about its own axes at the start
    [rad]; ``velocity_x`` and so on are velocities of the frame's origin in the world [m/s], ``turning_x`` and so on angular [rad/s].

    mjlab: reset_root_state_uniform. Isaac Lab: reset_root_state_uniform.
    """
    offset = wp.vec3(between(stream, 0, x), between(stream, 1, y), between(stream, 2, z))
    turn = quaternion_from_angles(between(stream, 3, roll), between(stream, 4, pitch), between(stream, 5, yaw))
    linear = wp.vec3(between(stream, 6, velocity_x), between(stream, 7, velocity_y), between(stream, 8, velocity_z))
    angular = wp.vec3(between(stream, 9, turning_x), between(stream, 10, turning_y), between(stream, 11, turning_z))
    place_root(world, worlds, robot, bodies, wp.vec3(0.0, 0.0, 0.0), offset, turn, linear, angular)


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

    mjlab: -. Isaac Lab: reset_root_state_with_random_orientation.
    """
    offset = wp.vec3(between(stream, 0, x), between(stream, 1, y), between(stream, 2, z))
    nothing = wp.vec3(0.0, 0.0, 0.0)
    turn = random_quaternion(wp.rand_init(int(stream), 3))
    place_root(world, worlds, robot, bodies, nothing, offset, turn, nothing, nothing)


@wp.func
def reset_to_default(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays):
    """Put a robot or object at its declared pose, with its joints at their default positions, all at rest.

    mjlab: reset_scene_to_default. Isaac Lab: reset_scene_to_default.
    """
    nothing = wp.vec3(0.0, 0.0, 0.0)
    place_root(world, worlds, robot, bodies, nothing, nothing, wp.quat_identity(), nothing, nothing)
    for joint in range(robot.coordinates.shape[0]):
        set_joint(worlds, robot, world, joint, robot.defaults[joint], 0.0)


@wp.func
def reset_joints_by_offset(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    joint: int,
    stream: wp.uint32,
    position: wp.vec2,
    velocity: wp.vec2 = NONE,
    soft_factor: float = 1.0,
):
    """Put a joint at its default + an offset from ``position`` [m, rad], with a velocity from ``velocity`` [m/s, rad/s].

    The position stays within ``soft_factor`` times the joint's range about its middle.

    mjlab: reset_joints_by_offset. Isaac Lab: reset_joints_by_offset.
    """
    place = within_limits(robot, joint, robot.defaults[joint] + between(stream, 0, position), soft_factor)
    set_joint(worlds, robot, world, joint, place, between(stream, 1, velocity))


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

    mjlab: -. Isaac Lab: reset_joints_by_scale (which scales the default velocity, 0 as a rule).
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

    mjlab: -. Isaac Lab: reset_joints_within_limits_range.
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

    mjlab: -. Isaac Lab: reset_joints_within_limits_range (with scale).
    """
    ends = robot.ranges[joint]
    place = robot.defaults[joint]
    if wp.isfinite(ends[1] - ends[0]):
        half = 0.5 * soft_factor * (ends[1] - ends[0])
        place = 0.5 * (ends[0] + ends[1]) + between(stream, 0, wp.vec2(-half, half))
    set_joint(worlds, robot, world, joint, place, between(stream, 1, velocity))


@needs(free_root=True)
@wp.func
def push(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    stream: wp.uint32,
    velocity_x: wp.vec2 = NONE,
    velocity_y: wp.vec2 = NONE,
    velocity_z: wp.vec2 = NONE,
    turning_x: wp.vec2 = NONE,
    turning_y: wp.vec2 = NONE,
    turning_z: wp.vec2 = NONE,
):
    """Add velocities to a free root at once, drawn evenly: of its frame's origin [m/s] and angular [rad/s], in the world frame.

    mjlab: push_by_setting_velocity. Isaac Lab: push_by_setting_velocity.
    """
    linear = wp.vec3(between(stream, 0, velocity_x), between(stream, 1, velocity_y), between(stream, 2, velocity_z))
    angular = wp.vec3(between(stream, 3, turning_x), between(stream, 4, turning_y), between(stream, 5, turning_z))
    linear = linear + root_origin_velocity(worlds, robot, bodies, world)
    angular = angular + root_turning(worlds, robot, world)
    set_root_velocity(worlds, robot, bodies, world, linear, angular)


@wp.func
def _draw_wrenches(world: int, wrench: WrenchArrays, stream: wp.uint32, force: wp.vec2, torque: wp.vec2):
    """Each component of each body's force and torque evenly from its range."""
    for index in range(wrench.bodies.shape[0]):
        first = 6 * index
        wrench.wrenches[world, wrench.bodies[index]] = wp.spatial_vector(
            between(stream, first, force),
            between(stream, first + 1, force),
            between(stream, first + 2, force),
            between(stream, first + 3, torque),
            between(stream, first + 4, torque),
            between(stream, first + 5, torque),
        )


@wp.func
def apply_wrench(world: int, wrench: WrenchArrays, stream: wp.uint32, force: wp.vec2 = NONE, torque: wp.vec2 = NONE):
    """Apply a wrench to each body of an ``ExternalWrench`` until the end of the episode, like wind or a load.

    Each component of the force at its centre of mass [N] and of the torque [N m], in the world frame, is drawn evenly from its range.
    It replaces earlier wrenches.

    mjlab: apply_external_force_torque. Isaac Lab: apply_external_force_torque.
    """
    _draw_wrenches(world, wrench, stream, force, torque)
    wrench.left[world] = LASTING_FROM_NOW


@wp.func
def apply_impulse(
    world: int,
    wrench: WrenchArrays,
    stream: wp.uint32,
    duration: wp.vec2,
    force: wp.vec2 = NONE,
    torque: wp.vec2 = NONE,
):
    """Apply a wrench to each body of an ``ExternalWrench`` for a time drawn from ``duration`` [s], like a bump or a gust.

    Each component of the force at its centre of mass [N] and of the torque [N m], in the world frame, is drawn evenly from its range.
    Use it at intervals longer than ``duration``.

    mjlab: apply_body_impulse (whose cooldown_s begins when an impulse is over). Isaac Lab: -.
    """
    _draw_wrenches(world, wrench, stream, force, torque)
    wrench.left[world] = wp.max(
        between(stream, 6 * wrench.bodies.shape[0], duration), 1.0e-6
    )  # one control step at least
