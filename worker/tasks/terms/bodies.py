"""Single bodies of a robot: poses, velocities, heights.

Each function is called for one body; rewards are summed over the bodies of the term. Velocities are those of the origin of the body's
frame, unless the name says centre of mass.
"""

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


@wp.func
def body_height(world: int, bodies: BodyArrays, body: int) -> float:
    """Height of a body's origin above z = 0 [m].

    mjlab: -. Isaac Lab: -.
    """
    return body_position_of(bodies, world, body)[2]


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
    """Position of a body's origin in the root's frame [m].

    mjlab: robot_body_pos_b (where the anchor is the root). Isaac Lab: -.
    """
    way = body_position_of(bodies, world, body) - root_position_of(worlds, robot, world)
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), way)


@wp.func
def body_orientation_in_root(
    world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int
) -> wp.quat:
    """Rotation from a body to the root's frame, a quaternion xyzw whose w is not negative.

    mjlab: -. Isaac Lab: -.
    """
    root = root_rotation_of(worlds, robot, world)
    return unique_quaternion(wp.quat_inverse(root) * body_rotation_of(bodies, world, body))


@wp.func
def body_forward_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int) -> wp.vec3:
    """A body's x axis in the root's frame, a unit vector: the first column of its rotation matrix there.

    mjlab: robot_body_ori_b (half of its numbers). Isaac Lab: -.
    """
    axis = wp.quat_rotate(body_rotation_of(bodies, world, body), wp.vec3(1.0, 0.0, 0.0))
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), axis)


@wp.func
def body_left_in_root(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int) -> wp.vec3:
    """A body's y axis in the root's frame, a unit vector: the second column of its rotation matrix there.

    mjlab: robot_body_ori_b (half of its numbers). Isaac Lab: -.
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
def body_angular_velocity(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Angular velocity of a body in the world frame [rad/s].

    mjlab: body_link_ang_vel_w (of an entity's data). Isaac Lab: body_ang_vel_w (of an articulation's data).
    """
    return body_turning(bodies, world, body)


@wp.func
def body_linear_velocity_in_own_frame(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Velocity of a body's origin in the body's own frame [m/s].

    mjlab: ee_velocity (of a body instead of a site). Isaac Lab: -.
    """
    return wp.quat_rotate_inv(body_rotation_of(bodies, world, body), body_origin_velocity(bodies, world, body))


@wp.func
def body_angular_velocity_in_own_frame(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Angular velocity of a body in the body's own frame [rad/s], as its gyroscope shows it.

    mjlab: -. Isaac Lab: -.
    """
    return wp.quat_rotate_inv(body_rotation_of(bodies, world, body), body_turning(bodies, world, body))


@wp.func
def body_velocity_in_root(
    world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int
) -> wp.vec3:
    """Velocity of a body's origin relative to the world, along the root's axes [m/s].

    mjlab: -. Isaac Lab: -.
    """
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), body_origin_velocity(bodies, world, body))


@wp.func
def body_projected_gravity(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Direction of gravity, a unit vector, in a body's frame: (0, 0, -1) when it stands upright.

    mjlab: -. Isaac Lab: body_projected_gravity_b.
    """
    return wp.quat_rotate_inv(body_rotation_of(bodies, world, body), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def body_tilt_squared(world: int, bodies: BodyArrays, body: int) -> float:
    """Square of the sine of a body's tilt, in [0, 1].

    mjlab: -. Isaac Lab: -.
    """
    gravity = body_projected_gravity(world, bodies, body)
    return gravity[0] * gravity[0] + gravity[1] * gravity[1]


@wp.func
def body_upright(world: int, bodies: BodyArrays, body: int, std: float) -> float:
    """exp(-sin(tilt)^2 / std^2) of a body, in (0, 1]: 1 when it stands upright.

    mjlab: upright (with body names). Isaac Lab: -.
    """
    return wp.exp(-body_tilt_squared(world, bodies, body) / (std * std))


@wp.func
def body_tipping_rate_squared(world: int, bodies: BodyArrays, body: int) -> float:
    """Square of a body's angular velocity about the world's x and y axes [rad^2/s^2].

    mjlab: body_angular_velocity_penalty. Isaac Lab: -.
    """
    angular = body_turning(bodies, world, body)
    return angular[0] * angular[0] + angular[1] * angular[1]


@wp.func
def body_speed(world: int, bodies: BodyArrays, body: int) -> float:
    """Speed of a body's origin [m/s].

    mjlab: -. Isaac Lab: -.
    """
    return wp.length(body_origin_velocity(bodies, world, body))


@wp.func
def body_speed_squared(world: int, bodies: BodyArrays, body: int) -> float:
    """Square of the speed of a body's origin [m^2/s^2].

    mjlab: -. Isaac Lab: -.
    """
    return wp.length_sq(body_origin_velocity(bodies, world, body))


@wp.func
def body_height_error_squared(world: int, bodies: BodyArrays, body: int, target: float) -> float:
    """Square of the height of a body's origin minus ``target`` [m^2].

    mjlab: -. Isaac Lab: -.
    """
    error = body_height(world, bodies, body) - target
    return error * error


@wp.func
def body_turn_from_root(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, body: int) -> float:
    """Angle between a body's frame and the root's, in [0, pi] [rad].

    mjlab: -. Isaac Lab: -.
    """
    return quaternion_error(root_rotation_of(worlds, robot, world), body_rotation_of(bodies, world, body))


@wp.func
def body_too_low(world: int, bodies: BodyArrays, body: int, height: float) -> bool:
    """Whether a body's origin is below ``height`` above z = 0 [m].

    mjlab: -. Isaac Lab: -.
    """
    return body_height(world, bodies, body) < height


@wp.func
def body_tilted(world: int, bodies: BodyArrays, body: int, limit: float) -> bool:
    """Whether a body's z axis is more than ``limit`` from the vertical [rad].

    mjlab: -. Isaac Lab: -.
    """
    return body_projected_gravity(world, bodies, body)[2] > -wp.cos(limit)
