"""Single bodies: further measurements, costs and limits."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import (
    body_com_velocity,
    body_origin_velocity,
    body_position_of,
    body_rotation_of,
    body_turning,
    quaternion_error,
    root_position_of,
    root_rotation_of,
    unique_quaternion,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.bodies import body_projected_gravity
from worker.tasks.terms.composing import below, composed, difference, length, length_squared, squared, vertical

wp.set_module_options({"enable_backward": False})


@wp.func
def body_position(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Position of a body's origin in the world frame [m].

    mjlab: body_link_pos_w (of an entity's data). Isaac Lab: body_pose_w (its first three numbers).
    """
    return body_position_of(bodies, world, body)


@wp.func
def body_orientation(world: int, bodies: BodyArrays, body: int) -> wp.quat:
    """Rotation from a body to the world frame, a quaternion xyzw whose w is not negative.

    mjlab: body_link_quat_w (of an entity's data, wxyz). Isaac Lab: body_pose_w (its last four numbers, wxyz).
    """
    return unique_quaternion(body_rotation_of(bodies, world, body))


@composed(vertical, body_position)
def body_height():
    """Height of a body's origin above z = 0 [m]."""


@wp.func
def body_com_position(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Position of a body's centre of mass in the world frame [m].

    mjlab: body_com_pos_w (of an entity's data). Isaac Lab: body_com_pos_w (of an articulation's data).
    """
    return wp.transform_point(bodies.poses[world, body], bodies.coms[world, body])


@wp.func
def body_position_in_root(
    world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int
) -> wp.vec3:
    """Position of a body's origin in the root's frame [m]. mjlab: robot_body_pos_b (where the anchor is the root)."""
    way = body_position_of(bodies, world, body) - root_position_of(worlds, robot, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def body_orientation_in_root(
    world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int
) -> wp.quat:
    """Rotation from a body to the root's frame, a quaternion xyzw whose w is not negative."""
    root = root_rotation_of(worlds, robot, world)
    return unique_quaternion(wp.quat_inverse(root) * body_rotation_of(bodies, world, body))


@wp.func
def body_forward_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int) -> wp.vec3:
    """A body's x axis in the root's frame, a unit vector: the first column of its rotation matrix there.

    mjlab: robot_body_ori_b (half of its numbers).
    """
    axis = wp.quat_rotate(body_rotation_of(bodies, world, body), wp.vec3(1.0, 0.0, 0.0))
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), axis)


@wp.func
def body_left_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int) -> wp.vec3:
    """A body's y axis in the root's frame, a unit vector: the second column of its rotation matrix there.

    mjlab: robot_body_ori_b (half of its numbers).
    """
    axis = wp.quat_rotate(body_rotation_of(bodies, world, body), wp.vec3(0.0, 1.0, 0.0))
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), axis)


@wp.func
def body_linear_velocity(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Velocity of a body's origin in the world frame [m/s].

    mjlab: body_link_lin_vel_w (of an entity's data). Isaac Lab: body_link_lin_vel_w (of an articulation's data).
    """
    return body_origin_velocity(bodies, world, body)


@wp.func
def body_com_linear_velocity(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Velocity of a body's centre of mass in the world frame [m/s].

    mjlab: body_com_lin_vel_w (of an entity's data). Isaac Lab: body_lin_vel_w (of an articulation's data).
    """
    return body_com_velocity(bodies, world, body)


@wp.func
def body_linear_velocity_in_own_frame(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Velocity of a body's origin in the body's own frame [m/s]. mjlab: ee_velocity (of a body instead of a site)."""
    return wp.quat_rotate_inv(body_rotation_of(bodies, world, body), body_origin_velocity(bodies, world, body))


@wp.func
def body_angular_velocity_in_own_frame(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Angular velocity of a body in the body's own frame [rad/s], as its gyroscope shows it."""
    return wp.quat_rotate_inv(body_rotation_of(bodies, world, body), body_turning(bodies, world, body))


@wp.func
def body_velocity_in_root(
    world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int
) -> wp.vec3:
    """Velocity of a body's origin relative to the world, along the root's axes [m/s]."""
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), body_origin_velocity(bodies, world, body))


@composed(length, body_linear_velocity)
def body_speed():
    """Speed of a body's origin [m/s]."""


@composed(length_squared, body_linear_velocity)
def body_speed_squared():
    """Square of the speed of a body's origin [m^2/s^2]."""


@composed(squared, difference, body_height)
def body_height_error_squared(target: float):
    """Square of the height of a body's origin minus ``target`` [m^2]."""


@wp.func
def body_turn_from_root(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int) -> float:
    """Angle between a body's frame and the root's, in [0, pi] [rad]."""
    return quaternion_error(root_rotation_of(worlds, robot, world), body_rotation_of(bodies, world, body))


@composed(below, body_height)
def body_too_low(height: float):
    """Whether a body's origin is below ``height`` above z = 0 [m]."""


@wp.func
def body_tilted(world: int, bodies: BodyArrays, body: int, limit: float) -> bool:
    """Whether a body's z axis is more than ``limit`` from the vertical [rad]."""
    return body_projected_gravity(world, bodies, body)[2] > -wp.cos(limit)
