"""The root of a robot or object: pose, velocities, gravity, heading.

"In its own frame" is the frame of the root's body. The velocity of the frame's origin corresponds to the ``root_link`` quantities of
mjlab and Isaac Lab; the velocity of the centre of mass costs less here, and differs if the two points differ.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import (
    angles_of,
    root_com_velocity,
    root_origin_velocity,
    root_position_of,
    root_rotation_of,
    root_turning,
    turn_element,
    unique_quaternion,
    wrapped_angle,
    yaw_of,
    yaw_quaternion,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs

wp.set_module_options({"enable_backward": False})


@wp.func
def root_position(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Position of the root in the world frame [m].

    mjlab: -. Isaac Lab: root_pos_w.
    """
    return root_position_of(worlds, robot, world)


@wp.func
def root_displacement(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Displacement of the root from its declared start, in the world frame [m].

    mjlab: -. Isaac Lab: -.
    """
    return root_position_of(worlds, robot, world) - wp.transform_get_translation(robot.start)


@wp.func
def root_height(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Height of the root's origin above z = 0 [m].

    mjlab: -. Isaac Lab: base_pos_z.
    """
    return root_position_of(worlds, robot, world)[2]


@wp.func
def root_orientation(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.quat:
    """Rotation from the root to the world frame, a quaternion xyzw whose w is not negative.

    mjlab: -. Isaac Lab: root_quat_w (wxyz).
    """
    return unique_quaternion(root_rotation_of(worlds, robot, world))


@needs(size=6)
@wp.func
def root_orientation_element(world: int, worlds: WorldArrays, robot: RobotArrays, index: int) -> float:
    """Element ``index``, one of six, of the first two columns of the root's rotation matrix, row by row.

    mjlab: -. Isaac Lab: -.
    """
    return turn_element(root_rotation_of(worlds, robot, world), index)


@wp.func
def root_angles(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Roll, pitch and yaw of the root [rad]: turns about the world's x, then y, then z.

    mjlab: -. Isaac Lab: base_yaw_roll (of the classic tasks, yaw and roll alone).
    """
    return angles_of(root_rotation_of(worlds, robot, world))


@wp.func
def heading(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Direction in which the root's x axis points, seen from above, in [-pi, pi] [rad].

    mjlab: heading_w (of an entity's data). Isaac Lab: heading_w (of an articulation's data).
    """
    return yaw_of(root_rotation_of(worlds, robot, world))


@wp.func
def projected_gravity(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Direction of gravity, a unit vector, in the root's frame: (0, 0, -1) when it stands upright.

    mjlab: projected_gravity. Isaac Lab: projected_gravity.
    """
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def root_uprightness(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Cosine of the angle between the root's z axis and the vertical: 1 upright, -1 upside down.

    mjlab: -. Isaac Lab: base_up_proj (of the classic tasks).
    """
    return wp.quat_rotate(root_rotation_of(worlds, robot, world), wp.vec3(0.0, 0.0, 1.0))[2]


@wp.func
def root_linear_velocity(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays) -> wp.vec3:
    """Velocity of the origin of the root's frame, in its own frame [m/s].

    mjlab: base_lin_vel. Isaac Lab: root_link_lin_vel_b (of an articulation's data).
    """
    return wp.quat_rotate_inv(
        root_rotation_of(worlds, robot, world), root_origin_velocity(worlds, robot, bodies, world)
    )


@wp.func
def root_com_linear_velocity(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Velocity of the centre of mass of the root's body, in its own frame [m/s].

    mjlab: root_com_lin_vel_b (of an entity's data). Isaac Lab: base_lin_vel.
    """
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), root_com_velocity(worlds, robot, world))


@wp.func
def root_angular_velocity(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Angular velocity of the root, in its own frame [rad/s].

    mjlab: base_ang_vel. Isaac Lab: base_ang_vel.
    """
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), root_turning(worlds, robot, world))


@wp.func
def root_linear_velocity_in_world(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays) -> wp.vec3:
    """Velocity of the origin of the root's frame, in the world frame [m/s].

    mjlab: root_link_lin_vel_w (of an entity's data). Isaac Lab: root_link_lin_vel_w (of an articulation's data).
    """
    return root_origin_velocity(worlds, robot, bodies, world)


@wp.func
def root_com_linear_velocity_in_world(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Velocity of the centre of mass of the root's body, in the world frame [m/s].

    mjlab: root_com_lin_vel_w (of an entity's data). Isaac Lab: root_lin_vel_w.
    """
    return root_com_velocity(worlds, robot, world)


@wp.func
def root_angular_velocity_in_world(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Angular velocity of the root, in the world frame [rad/s].

    mjlab: root_link_ang_vel_w (of an entity's data). Isaac Lab: root_ang_vel_w.
    """
    return root_turning(worlds, robot, world)


@wp.func
def root_velocity_in_heading_frame(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays) -> wp.vec3:
    """Velocity of the origin of the root's frame: forward and left as seen from above, and upwards [m/s].

    mjlab: -. Isaac Lab: -.
    """
    yaw = yaw_quaternion(root_rotation_of(worlds, robot, world))
    return wp.quat_rotate_inv(yaw, root_origin_velocity(worlds, robot, bodies, world))


@wp.func
def angle_to_point(world: int, worlds: WorldArrays, robot: RobotArrays, target: wp.vec2) -> float:
    """Angle by which the root must turn to face ``target``, x and y in the world frame [m], in [-pi, pi] [rad].

    mjlab: -. Isaac Lab: base_angle_to_target (of the classic tasks).
    """
    position = root_position_of(worlds, robot, world)
    direction = wp.atan2(target[1] - position[1], target[0] - position[0])
    return wrapped_angle(direction - yaw_of(root_rotation_of(worlds, robot, world)))


@wp.func
def facing_point(world: int, worlds: WorldArrays, robot: RobotArrays, target: wp.vec2) -> float:
    """Cosine between the root's x axis and the way to ``target``, x and y in the world frame [m], at the root's height: 1 faces it.

    mjlab: -. Isaac Lab: base_heading_proj (of the classic tasks).
    """
    position = root_position_of(worlds, robot, world)
    way = wp.normalize(wp.vec3(target[0] - position[0], target[1] - position[1], 0.0))
    return wp.dot(wp.quat_rotate(root_rotation_of(worlds, robot, world), wp.vec3(1.0, 0.0, 0.0)), way)


@wp.func
def velocity_towards(world: int, worlds: WorldArrays, robot: RobotArrays, direction: wp.vec3) -> float:
    """Velocity of the root's centre of mass along ``direction``, a vector of the world frame whose length does not matter [m/s].

    mjlab: -. Isaac Lab: progress_reward (of the classic tasks, which takes the difference of two distances to a far point).
    """
    return wp.dot(root_com_velocity(worlds, robot, world), wp.normalize(direction))


@wp.func
def vertical_velocity_squared(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays) -> float:
    """Square of the velocity of the root's origin along its own z axis [m^2/s^2].

    mjlab: -. Isaac Lab: -.
    """
    velocity = root_linear_velocity(world, worlds, robot, bodies)[2]
    return velocity * velocity


@wp.func
def vertical_com_velocity_squared(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Square of the velocity of the root's centre of mass along the root's z axis [m^2/s^2].

    mjlab: -. Isaac Lab: lin_vel_z_l2.
    """
    velocity = root_com_linear_velocity(world, worlds, robot)[2]
    return velocity * velocity


@wp.func
def tipping_rate_squared(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Square of the root's angular velocity about its own x and y axes [rad^2/s^2].

    mjlab: -. Isaac Lab: ang_vel_xy_l2.
    """
    angular = root_angular_velocity(world, worlds, robot)
    return angular[0] * angular[0] + angular[1] * angular[1]


@wp.func
def tilt_squared(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Square of the sine of the root's tilt: that of the part of gravity along its x and y axes, in [0, 1].

    mjlab: flat_orientation_l2. Isaac Lab: flat_orientation_l2.
    """
    gravity = projected_gravity(world, worlds, robot)
    return gravity[0] * gravity[0] + gravity[1] * gravity[1]


@wp.func
def upright(world: int, worlds: WorldArrays, robot: RobotArrays, std: float) -> float:
    """exp(-sin(tilt)^2 / std^2), in (0, 1]: 1 when the root stands upright.

    mjlab: upright. Isaac Lab: flat_orientation_exp (of the tracking tasks).
    """
    return wp.exp(-tilt_squared(world, worlds, robot) / (std * std))


@wp.func
def is_upright(world: int, worlds: WorldArrays, robot: RobotArrays, threshold: float) -> float:
    """1 where the cosine of the root's tilt is above ``threshold``, else 0.

    mjlab: -. Isaac Lab: upright_posture_bonus (of the classic tasks).
    """
    return wp.where(root_uprightness(world, worlds, robot) > threshold, 1.0, 0.0)


@wp.func
def height_error_squared(world: int, worlds: WorldArrays, robot: RobotArrays, target: float) -> float:
    """Square of the root's height minus ``target`` [m^2].

    mjlab: -. Isaac Lab: base_height_l2 (without a sensor).
    """
    error = root_height(world, worlds, robot) - target
    return error * error


@wp.func
def height_shortfall(world: int, worlds: WorldArrays, robot: RobotArrays, target: float) -> float:
    """Distance of the root below ``target`` [m], 0 above it.

    mjlab: -. Isaac Lab: -.
    """
    return wp.max(target - root_height(world, worlds, robot), 0.0)


@wp.func
def root_tilted(world: int, worlds: WorldArrays, robot: RobotArrays, limit: float) -> bool:
    """Whether the root's z axis is more than ``limit`` from the vertical [rad].

    mjlab: bad_orientation. Isaac Lab: bad_orientation.
    """
    return root_uprightness(world, worlds, robot) < wp.cos(limit)


@wp.func
def root_too_low(world: int, worlds: WorldArrays, robot: RobotArrays, height: float) -> bool:
    """Whether the root's origin is below ``height`` above z = 0 [m].

    mjlab: root_height_below_minimum. Isaac Lab: root_height_below_minimum.
    """
    return root_height(world, worlds, robot) < height


@wp.func
def root_too_high(world: int, worlds: WorldArrays, robot: RobotArrays, height: float) -> bool:
    """Whether the root's origin is above ``height`` above z = 0 [m].

    mjlab: -. Isaac Lab: -.
    """
    return root_height(world, worlds, robot) > height


@wp.func
def root_too_far(world: int, worlds: WorldArrays, robot: RobotArrays, distance: float) -> bool:
    """Whether the root is more than ``distance`` from its start, seen from above [m].

    mjlab: -. Isaac Lab: terrain_out_of_bounds (on a plane there are no bounds).
    """
    way = root_displacement(world, worlds, robot)
    return wp.length(wp.vec2(way[0], way[1])) > distance


@wp.func
def root_too_fast(world: int, worlds: WorldArrays, robot: RobotArrays, linear: float, angular: float) -> bool:
    """Whether the root's centre of mass is faster than ``linear`` [m/s], or it turns faster than ``angular`` [rad/s].

    mjlab: -. Isaac Lab: -.
    """
    moves = wp.length(root_com_velocity(worlds, robot, world)) > linear
    return moves or wp.length(root_turning(worlds, robot, world)) > angular
