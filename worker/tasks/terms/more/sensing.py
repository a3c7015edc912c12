"""Measurements of sensors: further ones."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import turn_element, unique_quaternion
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.imu import ImuArrays
from worker.simulation.sensors.momentum import MomentumArrays
from worker.simulation.sensors.rays import RayArrays
from worker.tasks.declare.term_needs import needs

wp.set_module_options({"enable_backward": False})


@wp.func
def imu_acceleration(world: int, imu: ImuArrays) -> wp.vec3:
    """Acceleration minus gravity, in the unit's own frame [m/s^2]; at rest it points up.

    mjlab: builtin_sensor (an accelerometer). Isaac Lab: imu_lin_acc.
    """
    return imu.accelerometer[world]


@wp.func
def imu_orientation(world: int, imu: ImuArrays) -> wp.quat:
    """Rotation from the unit to the world frame, a quaternion xyzw whose w is not negative.

    mjlab: builtin_sensor (a framequat, wxyz). Isaac Lab: imu_orientation (wxyz).
    """
    return unique_quaternion(imu.rotations[world])


@wp.func
def imu_projected_gravity(world: int, imu: ImuArrays) -> wp.vec3:
    """Direction of gravity, a unit vector, in the unit's own frame.

    mjlab: projected_gravity_from_sensor. Isaac Lab: imu_projected_gravity.
    """
    return wp.quat_rotate_inv(imu.rotations[world], wp.vec3(0.0, 0.0, -1.0))


@wp.func
def imu_acceleration_squared(world: int, imu: ImuArrays, gravity: float = 9.81) -> float:
    """Square of the unit's acceleration without ``gravity`` [m^2/s^4]: 0 at rest.

    Isaac Lab: body_lin_acc_l2 (of the body that it is on).
    """
    up = wp.quat_rotate_inv(imu.rotations[world], wp.vec3(0.0, 0.0, gravity))
    return wp.length_sq(imu.accelerometer[world] - up)


@wp.func
def frame_position(world: int, frames: FrameArrays, index: int) -> wp.vec3:
    """Position of a frame's origin, in the frame that the sensor refers to [m].

    mjlab: builtin_sensor (a framepos). Isaac Lab: target_pos_source (of a frame transformer's data).
    """
    return frames.positions[world, index]


@wp.func
def frame_orientation(world: int, frames: FrameArrays, index: int) -> wp.quat:
    """Rotation of a frame, a quaternion xyzw whose w is not negative.

    mjlab: builtin_sensor (a framequat, wxyz). Isaac Lab: target_quat_source (of a frame transformer's data, wxyz).
    """
    return unique_quaternion(frames.rotations[world, index])


@needs(size=6)
@wp.func
def frame_orientation_element(world: int, frames: FrameArrays, index: int) -> float:
    """Element ``index``, one of six, of the first two columns of the rotation matrix of the sensor's first frame, row by row."""
    return turn_element(frames.rotations[world, 0], index)


@wp.func
def frame_linear_velocity(world: int, frames: FrameArrays, index: int) -> wp.vec3:
    """Velocity of a frame's origin [m/s]. mjlab: builtin_sensor (a framelinvel)."""
    return frames.linear[world, index]


@wp.func
def frame_angular_velocity(world: int, frames: FrameArrays, index: int) -> wp.vec3:
    """Angular velocity of a frame [rad/s]. mjlab: builtin_sensor (a frameangvel)."""
    return frames.angular[world, index]


@wp.func
def frame_velocity_in_own_frame(world: int, frames: FrameArrays, index: int) -> wp.vec3:
    """Velocity of a frame's origin, along the frame's own axes [m/s]. mjlab: ee_velocity."""
    return wp.quat_rotate_inv(frames.rotations[world, index], frames.linear[world, index])


@wp.func
def center_of_mass_velocity(world: int, momentum: MomentumArrays) -> wp.vec3:
    """Velocity of the common centre of mass, in the world frame [m/s]. mjlab: builtin_sensor (a subtreelinvel)."""
    return momentum.velocities[world]


@wp.func
def center_of_mass(world: int, momentum: MomentumArrays) -> wp.vec3:
    """Common centre of mass, in the world frame [m]. mjlab: builtin_sensor (a subtreecom)."""
    return momentum.centers[world]


@wp.func
def ray_distance(world: int, rays: RayArrays, index: int) -> float:
    """Distance to what a ray hits [m], of each ray; at most ``max_distance`` of the ``RayCaster``.

    mjlab: builtin_sensor (distances of a RayCastSensor). Isaac Lab: ray_hits_w (of a RayCaster's data, as points).
    """
    return rays.distances[world, index]


@wp.func
def nearest_obstacle(world: int, rays: RayArrays) -> float:
    """Distance to the nearest hit of any ray [m]."""
    nearest = float(wp.inf)
    for ray in range(rays.distances.shape[1]):
        nearest = wp.min(nearest, rays.distances[world, ray])
    return nearest
