"""Measurements of inertial measurement units, frames, momentum sensors and rays."""

from __future__ import annotations

import warp as wp

from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.imu import ImuArrays
from worker.simulation.sensors.momentum import MomentumArrays
from worker.tasks.terms.composing import composed, length_squared

wp.set_module_options({"enable_backward": False})


@wp.func
def imu_angular_velocity(world: int, imu: ImuArrays) -> wp.vec3:
    """Angular velocity, in the unit's own frame [rad/s]. mjlab: builtin_sensor (a gyro). Isaac Lab: imu_ang_vel."""
    return imu.gyro[world]


@wp.func
def imu_linear_velocity(world: int, imu: ImuArrays) -> wp.vec3:
    """Velocity of the unit, in its own frame [m/s].

    mjlab: builtin_sensor (a velocimeter). Isaac Lab: lin_vel_b (of an IMU's data).
    """
    return imu.velocimeter[world]


@wp.func
def frame_height(world: int, frames: FrameArrays, index: int) -> float:
    """Height of a frame's origin along z of the sensor's reference [m]. mjlab: foot_height (on flat ground)."""
    return frames.positions[world, index][2]


@wp.func
def angular_momentum(world: int, momentum: MomentumArrays) -> wp.vec3:
    """Angular momentum about the common centre of mass, in the world frame [kg m^2/s].

    mjlab: builtin_sensor (a subtreeangmom).
    """
    return momentum.angular[world]


@composed(length_squared, angular_momentum)
def angular_momentum_squared():
    """Square of the angular momentum about the centre of mass [kg^2 m^4/s^2]. mjlab: angular_momentum_penalty."""
