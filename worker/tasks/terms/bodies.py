"""Single bodies of a robot: poses, velocities, heights.

Each function is called for one body; rewards are summed over the bodies of the term. Velocities are those of the origin of the body's
frame, unless the name says centre of mass.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import body_rotation_of, body_turning
from worker.simulation.robot_arrays import BodyArrays
from worker.tasks.terms.composing import composed, likeness, planar_squared

wp.set_module_options({"enable_backward": False})


@wp.func
def body_angular_velocity(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Angular velocity of a body in the world frame [rad/s].

    mjlab: body_link_ang_vel_w (of an entity's data). Isaac Lab: body_ang_vel_w (of an articulation's data).
    """
    return body_turning(bodies, world, body)


@wp.func
def body_projected_gravity(world: int, bodies: BodyArrays, body: int) -> wp.vec3:
    """Direction of gravity, a unit vector, in a body's frame: (0, 0, -1) when it stands upright.

    Isaac Lab: body_projected_gravity_b.
    """
    return wp.quat_rotate_inv(body_rotation_of(bodies, world, body), wp.vec3(0.0, 0.0, -1.0))


@composed(planar_squared, body_projected_gravity)
def body_tilt_squared():
    """Square of the sine of a body's tilt, in [0, 1]."""


@composed(likeness, body_tilt_squared)
def body_upright(std: float):
    """exp(-sin(tilt)^2 / std^2) of a body, in (0, 1]: 1 when it stands upright. mjlab: upright (with body names)."""


@composed(planar_squared, body_angular_velocity)
def body_tipping_rate_squared():
    """Square of a body's angular velocity about the world's x and y axes [rad^2/s^2].

    mjlab: body_angular_velocity_penalty.
    """
