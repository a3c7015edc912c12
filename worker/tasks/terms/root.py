"""The root of a robot or object: pose, velocities, gravity, heading.

"In its own frame" is the frame of the root's body. The velocity of the frame's origin corresponds to the ``root_link`` quantities of
mjlab and Isaac Lab; the velocity of the centre of mass costs less here, and differs if the two points differ.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import (
    root_com_velocity,
    root_origin_velocity,
    root_position_of,
    root_rotation_of,
    root_turning,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.composing import above, below, composed, flag, planar_squared

wp.set_module_options({"enable_backward": False})


@wp.func
def root_height(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Height of the root's origin above z = 0 [m]. Isaac Lab: base_pos_z."""
    return root_position_of(worlds, robot, world)[2]


@wp.func
def projected_gravity(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Direction of gravity, a unit vector, in the root's frame: (0, 0, -1) when it stands upright.

    mjlab, Isaac Lab: projected_gravity.
    """
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def root_uprightness(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Cosine of the angle between the root's z axis and the vertical: 1 upright, -1 upside down.

    Isaac Lab: base_up_proj (of the classic tasks).
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
    """Angular velocity of the root, in its own frame [rad/s]. mjlab, Isaac Lab: base_ang_vel."""
    return wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), root_turning(worlds, robot, world))


@wp.func
def root_com_linear_velocity_in_world(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec3:
    """Velocity of the centre of mass of the root's body, in the world frame [m/s].

    mjlab: root_com_lin_vel_w (of an entity's data). Isaac Lab: root_lin_vel_w.
    """
    return root_com_velocity(worlds, robot, world)


@wp.func
def velocity_towards(world: int, worlds: WorldArrays, robot: RobotArrays, direction: wp.vec3) -> float:
    """Velocity of the root's centre of mass along ``direction``, a vector of the world frame whose length does not matter [m/s].

    Isaac Lab: progress_reward (of the classic tasks, which takes the difference of two distances to a far point).
    """
    return wp.dot(root_com_velocity(worlds, robot, world), wp.normalize(direction))


@composed(planar_squared, root_angular_velocity)
def tipping_rate_squared():
    """Square of the root's angular velocity about its own x and y axes [rad^2/s^2]. Isaac Lab: ang_vel_xy_l2."""


@composed(planar_squared, projected_gravity)
def tilt_squared():
    """Square of the sine of the root's tilt: that of the part of gravity along its x and y axes, in [0, 1].

    mjlab, Isaac Lab: flat_orientation_l2.
    """


@composed(flag, above, root_uprightness)
def is_upright(threshold: float):
    """1 where the cosine of the root's tilt is above ``threshold``, else 0.

    Isaac Lab: upright_posture_bonus (of the classic tasks).
    """


@wp.func
def root_tilted(world: int, worlds: WorldArrays, robot: RobotArrays, limit: float) -> bool:
    """Whether the root's z axis is more than ``limit`` from the vertical [rad]. mjlab, Isaac Lab: bad_orientation."""
    return root_uprightness(world, worlds, robot) < wp.cos(limit)


@composed(below, root_height)
def root_too_low(height: float):
    """Whether the root's origin is below ``height`` above z = 0 [m]. mjlab, Isaac Lab: root_height_below_minimum."""
