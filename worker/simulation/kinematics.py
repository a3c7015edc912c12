"""The kinematics of a robot's root and of its bodies: poses, velocities and rotations, as functions that kernels call.

Quaternions are xyzw and turn a body's frame to the world's. A body has two linear velocities: that of its centre of mass, which
Newton keeps (``joint_qd`` of a free joint, ``body_qd``), and that of its frame's origin, which MuJoCo, mjlab and Isaac Lab call the
velocity of the link. They differ by the angular velocity times the offset between both points, and every name here says which one it means.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})


@wp.func
def wrapped_angle(angle: float) -> float:
    """The same angle in [-pi, pi] [rad]."""
    return angle - 2.0 * wp.pi * wp.round(angle / (2.0 * wp.pi))


@wp.func
def yaw_of(rotation: wp.quat) -> float:
    """Direction in which a frame's x axis points, seen from above, in [-pi, pi] [rad]: 0 along x, pi / 2 along y."""
    forward = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(forward[1], forward[0])


@wp.func
def yaw_quaternion(rotation: wp.quat) -> wp.quat:
    """The turn about the vertical that is in a rotation, by :func:`yaw_of`."""
    half = 0.5 * yaw_of(rotation)
    return wp.quat(0.0, 0.0, wp.sin(half), wp.cos(half))


@wp.func
def quaternion_from_angles(roll: float, pitch: float, yaw: float) -> wp.quat:
    """Rotation by roll about x, then pitch about y, then yaw about z, axes of the world [rad]."""
    x = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), roll)
    y = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), pitch)
    z = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    return z * y * x


@wp.func
def angles_of(rotation: wp.quat) -> wp.vec3:
    """Roll, pitch and yaw of a rotation [rad], those of :func:`quaternion_from_angles`; pitch is in [-pi/2, pi/2]."""
    x, y, z, w = rotation[0], rotation[1], rotation[2], rotation[3]
    roll = wp.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = wp.asin(wp.clamp(2.0 * (w * y - z * x), -1.0, 1.0))
    return wp.vec3(roll, pitch, yaw_of(rotation))


@wp.func
def unique_quaternion(rotation: wp.quat) -> wp.quat:
    """The one of the two quaternions of a rotation whose w is not negative, since a network sees numbers, not rotations."""
    if rotation[3] < 0.0:
        return -rotation
    return rotation


@wp.func
def quaternion_error(first: wp.quat, second: wp.quat) -> float:
    """Angle of the rotation that turns one frame into the other, in [0, pi] [rad]."""
    between = wp.quat_inverse(first) * second
    return 2.0 * wp.atan2(wp.length(wp.vec3(between[0], between[1], between[2])), wp.abs(between[3]))


@wp.func
def turn_element(rotation: wp.quat, index: int) -> float:
    """Element ``index`` of the first two columns of a rotation's matrix, row by row: 0 and 1 are the first row's.

    These six numbers say the rotation without a jump anywhere, unlike angles and quaternions (Zhou et al., arXiv 1812.07035).
    """
    axis = wp.vec3(1.0, 0.0, 0.0)
    if index % 2 == 1:
        axis = wp.vec3(0.0, 1.0, 0.0)
    column = wp.quat_rotate(rotation, axis)
    return column[index // 2]


@wp.func
def random_quaternion(stream: wp.uint32) -> wp.quat:
    """A rotation drawn evenly from all (Shoemake, Graphics Gems III, 1992); it uses three numbers of the stream, which stays as it was."""
    share = wp.randf(stream)
    first = wp.randf(stream, 0.0, 2.0 * wp.pi)
    second = wp.randf(stream, 0.0, 2.0 * wp.pi)
    outer, inner = wp.sqrt(1.0 - share), wp.sqrt(share)
    return wp.quat(outer * wp.sin(first), outer * wp.cos(first), inner * wp.sin(second), inner * wp.cos(second))


@wp.func
def root_pose(worlds: WorldArrays, robot: RobotArrays, world: int) -> wp.transform:
    """Pose of a robot's root in the world frame [m, quaternion xyzw]; of a fixed one that of ``robot.start``."""
    first = robot.root_coordinate
    if first < 0:
        return robot.start
    position = wp.vec3(worlds.joint_q[world, first], worlds.joint_q[world, first + 1], worlds.joint_q[world, first + 2])
    rotation = wp.quat(
        worlds.joint_q[world, first + 3],
        worlds.joint_q[world, first + 4],
        worlds.joint_q[world, first + 5],
        worlds.joint_q[world, first + 6],
    )
    return wp.transform(position, rotation)


@wp.func
def root_position_of(worlds: WorldArrays, robot: RobotArrays, world: int) -> wp.vec3:
    """Position of a robot's root in the world frame [m]."""
    return wp.transform_get_translation(root_pose(worlds, robot, world))


@wp.func
def root_rotation_of(worlds: WorldArrays, robot: RobotArrays, world: int) -> wp.quat:
    """Rotation from a robot's root to the world frame."""
    return wp.transform_get_rotation(root_pose(worlds, robot, world))


@wp.func
def root_com_velocity(worlds: WorldArrays, robot: RobotArrays, world: int) -> wp.vec3:
    """Velocity of the centre of mass of a robot's root body, in the world frame [m/s]; 0 where the root is fixed."""
    first = robot.root_dof
    if first < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.vec3(worlds.joint_qd[world, first], worlds.joint_qd[world, first + 1], worlds.joint_qd[world, first + 2])


@wp.func
def root_turning(worlds: WorldArrays, robot: RobotArrays, world: int) -> wp.vec3:
    """Angular velocity of a robot's root, in the world frame [rad/s]; 0 where it is fixed."""
    first = robot.root_dof
    if first < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.vec3(
        worlds.joint_qd[world, first + 3], worlds.joint_qd[world, first + 4], worlds.joint_qd[world, first + 5]
    )


@wp.func
def root_origin_velocity(worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, world: int) -> wp.vec3:
    """Velocity of the origin of a robot's root frame, in the world frame [m/s]; it reads nothing of ``bodies`` but ``coms``."""
    arm = wp.quat_rotate(root_rotation_of(worlds, robot, world), bodies.coms[world, robot.root_body])
    return root_com_velocity(worlds, robot, world) - wp.cross(root_turning(worlds, robot, world), arm)


@wp.func
def set_root_pose(worlds: WorldArrays, robot: RobotArrays, world: int, pose: wp.transform):
    """Put a robot's free root there, in the world frame; a fixed one stays where it is."""
    first = robot.root_coordinate
    if first >= 0:
        position, rotation = wp.transform_get_translation(pose), wp.transform_get_rotation(pose)
        for axis in range(3):
            worlds.joint_q[world, first + axis] = position[axis]
        for axis in range(4):
            worlds.joint_q[world, first + 3 + axis] = rotation[axis]


@wp.func
def set_root_velocity(
    worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, world: int, linear: wp.vec3, angular: wp.vec3
):
    """Give a robot's free root these velocities of its frame's origin [m/s] and angular [rad/s], in the world frame; set its pose before."""
    first = robot.root_dof
    if first >= 0:
        arm = wp.quat_rotate(root_rotation_of(worlds, robot, world), bodies.coms[world, robot.root_body])
        of_com = linear + wp.cross(angular, arm)
        for axis in range(3):
            worlds.joint_qd[world, first + axis] = of_com[axis]
            worlds.joint_qd[world, first + 3 + axis] = angular[axis]


@wp.func
def body_position_of(bodies: BodyArrays, world: int, body: int) -> wp.vec3:
    """Position of the origin of a body's frame, in the world frame [m]."""
    return wp.transform_get_translation(bodies.poses[world, body])


@wp.func
def body_rotation_of(bodies: BodyArrays, world: int, body: int) -> wp.quat:
    """Rotation from a body's frame to the world frame."""
    return wp.transform_get_rotation(bodies.poses[world, body])


@wp.func
def body_com_velocity(bodies: BodyArrays, world: int, body: int) -> wp.vec3:
    """Velocity of a body's centre of mass, in the world frame [m/s]."""
    return wp.spatial_top(bodies.velocities[world, body])


@wp.func
def body_turning(bodies: BodyArrays, world: int, body: int) -> wp.vec3:
    """Angular velocity of a body, in the world frame [rad/s]."""
    return wp.spatial_bottom(bodies.velocities[world, body])


@wp.func
def body_point_velocity(bodies: BodyArrays, world: int, body: int, point: wp.vec3) -> wp.vec3:
    """Velocity of a point that is fixed to a body, in the world frame [m/s]; ``point`` is in the body's frame [m]."""
    arm = wp.quat_rotate(body_rotation_of(bodies, world, body), point - bodies.coms[world, body])
    return body_com_velocity(bodies, world, body) + wp.cross(body_turning(bodies, world, body), arm)


@wp.func
def body_origin_velocity(bodies: BodyArrays, world: int, body: int) -> wp.vec3:
    """Velocity of the origin of a body's frame, in the world frame [m/s]."""
    return body_point_velocity(bodies, world, body, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def body_point(bodies: BodyArrays, world: int, body: int, point: wp.vec3) -> wp.vec3:
    """Position in the world frame [m] of a point fixed to a body; ``point`` is in the body's frame [m]."""
    return wp.transform_point(bodies.poses[world, body], point)
