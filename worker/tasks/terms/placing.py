"""Functions shared by terms that place robots: draws from a stream, and placement of roots and joints."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import quaternion_from_angles, set_root_pose, set_root_velocity
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs

wp.set_module_options({"enable_backward": False})


NONE = wp.constant(wp.vec2(0.0, 0.0))
"""The range of a number that is not drawn."""


@wp.func
def between(stream: wp.uint32, number: int, bounds: wp.vec2) -> float:
    """Number ``number`` that is drawn from a stream, evenly from ``bounds``; each has a stream of its own."""
    own = wp.rand_init(int(stream), number)
    return wp.randf(own, bounds[0], bounds[1])


@wp.func
def place_root(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    origin: wp.vec3,
    offset: wp.vec3,
    turn: wp.quat,
    linear: wp.vec3,
    angular: wp.vec3,
):
    """Put the root at its start + ``origin`` + ``offset``, turned by ``turn`` in its own frame, with these velocities of the world frame."""
    position = wp.transform_get_translation(robot.start) + origin + offset
    set_root_pose(worlds, robot, world, wp.transform(position, wp.transform_get_rotation(robot.start) * turn))
    set_root_velocity(worlds, robot, bodies, world, linear, angular)


@wp.func
def set_joint(worlds: WorldArrays, robot: RobotArrays, world: int, joint: int, position: float, velocity: float):
    """Give a joint this position [m, rad] and velocity [m/s, rad/s]."""
    worlds.joint_q[world, robot.coordinates[joint]] = position
    worlds.joint_qd[world, robot.dofs[joint]] = velocity


@wp.func
def within_limits(robot: RobotArrays, joint: int, position: float, soft_factor: float) -> float:
    """A position within ``soft_factor`` times a joint's range about its middle."""
    ends = robot.ranges[joint]
    margin = 0.5 * (1.0 - soft_factor) * (ends[1] - ends[0])
    if not wp.isfinite(margin):
        margin = 0.0
    return wp.clamp(position, ends[0] + margin, ends[1] - margin)


@wp.func
def nowhere() -> wp.vec3:
    """The origin of a task without a terrain."""
    return wp.vec3(0.0, 0.0, 0.0)


@needs(free_root=True)
@wp.func
def draw_root(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    origin: wp.vec3,
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
    """Place a free root: its start + ``origin`` + offsets drawn evenly from ranges."""
    offset = wp.vec3(between(stream, 0, x), between(stream, 1, y), between(stream, 2, z))
    turn = quaternion_from_angles(between(stream, 3, roll), between(stream, 4, pitch), between(stream, 5, yaw))
    linear = wp.vec3(between(stream, 6, velocity_x), between(stream, 7, velocity_y), between(stream, 8, velocity_z))
    angular = wp.vec3(between(stream, 9, turning_x), between(stream, 10, turning_y), between(stream, 11, turning_z))
    place_root(world, worlds, robot, bodies, origin, offset, turn, linear, angular)


@wp.func
def place_default(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, origin: wp.vec3):
    """Put a robot or object at its declared pose + ``origin``, with its joints at their default positions, all at rest."""
    nothing = wp.vec3(0.0, 0.0, 0.0)
    place_root(world, worlds, robot, bodies, origin, nothing, wp.quat_identity(), nothing, nothing)
    for joint in range(robot.coordinates.shape[0]):
        set_joint(worlds, robot, world, joint, robot.defaults[joint], 0.0)
