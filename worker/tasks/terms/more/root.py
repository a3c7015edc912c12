"""The root: further measurements, costs and limits."""

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
from worker.tasks.terms.composing import above, composed, difference, likeness, planar_length, squared, vertical
from worker.tasks.terms.root import root_com_linear_velocity, root_height, root_linear_velocity, tilt_squared

wp.set_module_options({"enable_backward": False})


@wp.func
def root_position(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Position of the root in the world frame [m]. Isaac Lab: root_pos_w."""
    return root_position_of(worlds, robot, world)


@wp.func
def root_displacement(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Displacement of the root from its declared start, in the world frame [m]."""
    return root_position_of(worlds, robot, world) - wp.transform_get_translation(robot.start)


@wp.func
def root_orientation(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.quat:
    """Rotation from the root to the world, a quaternion xyzw whose w is not negative. Isaac Lab: root_quat_w (wxyz)."""
    return unique_quaternion(root_rotation_of(worlds, robot, world))


@needs(size=6)
@wp.func
def root_orientation_element(world: int, worlds: WorldArrays, robot: RobotArrays, index: int) -> float:
    """Element ``index``, one of six, of the first two columns of the root's rotation matrix, row by row."""
    return turn_element(root_rotation_of(worlds, robot, world), index)


@wp.func
def root_angles(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Roll, pitch and yaw of the root [rad]: turns about the world's x, then y, then z.

    Isaac Lab: base_yaw_roll (of the classic tasks, yaw and roll alone).
    """
    return angles_of(root_rotation_of(worlds, robot, world))


@wp.func
def heading(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Direction in which the root's x axis points, seen from above, in [-pi, pi] [rad].

    mjlab: heading_w (of an entity's data). Isaac Lab: heading_w (of an articulation's data).
    """
    return yaw_of(root_rotation_of(worlds, robot, world))


@wp.func
def root_linear_velocity_in_world(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays) -> wp.vec3:
    """Velocity of the origin of the root's frame, in the world frame [m/s].

    mjlab: root_link_lin_vel_w (of an entity's data). Isaac Lab: root_link_lin_vel_w (of an articulation's data).
    """
    return root_origin_velocity(worlds, robot, bodies, world)


@wp.func
def root_angular_velocity_in_world(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Angular velocity of the root, in the world frame [rad/s].

    mjlab: root_link_ang_vel_w (of an entity's data). Isaac Lab: root_ang_vel_w.
    """
    return root_turning(worlds, robot, world)


@wp.func
def root_velocity_in_heading_frame(world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays) -> wp.vec3:
    """Velocity of the origin of the root's frame: forward and left as seen from above, and upwards [m/s]."""
    yaw = yaw_quaternion(root_rotation_of(worlds, robot, world))
    return wp.quat_rotate_inv(yaw, root_origin_velocity(worlds, robot, bodies, world))


@wp.func
def angle_to_point(world: int, worlds: WorldArrays, robot: RobotArrays, target: wp.vec2) -> float:
    """Angle by which the root must turn to face ``target``, x and y in the world frame [m], in [-pi, pi] [rad].

    Isaac Lab: base_angle_to_target (of the classic tasks).
    """
    position = root_position_of(worlds, robot, world)
    direction = wp.atan2(target[1] - position[1], target[0] - position[0])
    return wrapped_angle(direction - yaw_of(root_rotation_of(worlds, robot, world)))


@wp.func
def facing_point(world: int, worlds: WorldArrays, robot: RobotArrays, target: wp.vec2) -> float:
    """Cosine between the root's x axis and the way to ``target``, x and y in the world frame [m], at the root's height: 1 faces it.

    Isaac Lab: base_heading_proj (of the classic tasks).
    """
    position = root_position_of(worlds, robot, world)
    way = wp.normalize(wp.vec3(target[0] - position[0], target[1] - position[1], 0.0))
    return wp.dot(wp.quat_rotate(root_rotation_of(worlds, robot, world), wp.vec3(1.0, 0.0, 0.0)), way)


@composed(squared, vertical, root_linear_velocity)
def vertical_velocity_squared():
    """Square of the velocity of the root's origin along its own z axis [m^2/s^2]."""


@composed(squared, vertical, root_com_linear_velocity)
def vertical_com_velocity_squared():
    """Square of the velocity of the root's centre of mass along its z axis [m^2/s^2]. Isaac Lab: lin_vel_z_l2."""


@composed(likeness, tilt_squared)
def upright(std: float):
    """exp(-sin(tilt)^2 / std^2), in (0, 1]: 1 when the root stands upright.

    mjlab: upright. Isaac Lab: flat_orientation_exp (of the tracking tasks).
    """


@composed(squared, difference, root_height)
def height_error_squared(target: float):
    """Square of the root's height minus ``target`` [m^2]. Isaac Lab: base_height_l2 (without a sensor)."""


@wp.func
def height_shortfall(world: int, worlds: WorldArrays, robot: RobotArrays, target: float) -> float:
    """Distance of the root below ``target`` [m], 0 above it."""
    return wp.max(target - root_height(world, worlds, robot), 0.0)


@composed(above, root_height)
def root_too_high(height: float):
    """Whether the root's origin is above ``height`` above z = 0 [m]."""


@composed(above, planar_length, root_displacement)
def root_too_far(distance: float):
    """Whether the root is more than ``distance`` from its start, seen from above [m].

    Isaac Lab: terrain_out_of_bounds (on a plane there are no bounds).
    """


@wp.func
def root_too_fast(world: int, worlds: WorldArrays, robot: RobotArrays, linear: float, angular: float) -> bool:
    """Whether the root's centre of mass is faster than ``linear`` [m/s], or it turns faster than ``angular`` [rad/s]."""
    moves = wp.length(root_com_velocity(worlds, robot, world)) > linear
    return moves or wp.length(root_turning(worlds, robot, world)) > angular
