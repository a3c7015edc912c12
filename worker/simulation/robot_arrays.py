"""Robot data for terms of a task: columns of its joints in the arrays of a world, and poses of bodies."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class RobotArrays:
    """Columns of a robot in the rows of a world, and constants of its model. Joints are those of one degree of freedom.

    Attributes:
        root_coordinate: First column of its free root in ``WorldArrays.joint_q`` (position, quaternion xyzw); -1: it is fixed.
        root_dof: First column of its free root in ``WorldArrays.joint_qd`` (linear, angular); -1: it is fixed.
        root_body: Its first body, a column of :class:`BodyArrays`.
        coordinates: Column of each joint in ``joint_q``, shape ``(joints,)``.
        dofs: Column of each joint in ``joint_qd`` and in ``drives``, shape ``(joints,)``.
        actuators: Column of each joint's actuator in ``controls``, -1 where it has none, shape ``(joints,)``.
        defaults: Default position of each joint [m, rad], shape ``(joints,)``.
        ranges: Lower and upper limit of each joint [m, rad], infinite where there is none, shape ``(joints,)``.
        references: What each joint's position is in its file where it is 0 here, MJCF's ``ref`` [m, rad], shape ``(joints,)``; the
            position inputs of actuators count as the file does.
        efforts: Greatest force or torque of each joint's actuator [N, N m], infinite where it is not limited, shape ``(joints,)``.
        gains: Force or torque on each joint per unit of its actuator's input, gear times gain [N, N m], shape ``(joints,)``; 1 without an
            actuator.
        encoder_bias: Offset of each joint's encoder [m, rad], shape ``(worlds, joints)``.
        start: Pose of the root at the start of an episode, in the world frame.
    """

    root_coordinate: int
    root_dof: int
    root_body: int
    coordinates: wp.array[wp.int32]
    dofs: wp.array[wp.int32]
    actuators: wp.array[wp.int32]
    defaults: wp.array[wp.float32]
    ranges: wp.array[wp.vec2]
    references: wp.array[wp.float32]
    efforts: wp.array[wp.float32]
    gains: wp.array[wp.float32]
    encoder_bias: wp.array2d[wp.float32]
    start: wp.transform


@wp.struct
class BodyArrays:
    """Poses and velocities of all bodies of a world, current after ``Worlds.update_bodies``.

    Attributes:
        poses: Of the bodies' frames, in the world frame [m, quaternion xyzw], shape ``(worlds, bodies)``.
        velocities: Linear velocity of the centre of mass [m/s], then angular [rad/s], in the world frame, shape ``(worlds, bodies)``.
        coms: Centre of mass in the body's frame [m], shape ``(worlds, bodies)``.
    """

    poses: wp.array2d[wp.transform]
    velocities: wp.array2d[wp.spatial_vectorf]
    coms: wp.array2d[wp.vec3]
