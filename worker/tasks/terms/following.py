"""Tracking rewards: rewards, terminations and metrics for a robot that follows a recorded motion.

As in :mod:`worker.tasks.terms.tracking`, :func:`motion_command` draws the ``command``. Means are over all bodies or joints of the motion;
to judge only some bodies, declare the motion a second time with these.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import (
    body_origin_velocity,
    body_position_of,
    body_rotation_of,
    body_turning,
    quaternion_error,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.motion import MotionArrays
from worker.tasks.terms.tracking import anchor_pose, frame_of, relative_reference, wanted_anchor

wp.set_module_options({"enable_backward": False})


@wp.func
def anchor_way(episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, world: int, command: int) -> wp.vec3:
    """Vector from the robot's anchor to the motion's, in the world frame [m]."""
    wanted = wp.transform_get_translation(wanted_anchor(motion, frame_of(episodes, motion, world, command)))
    return wanted - wp.transform_get_translation(anchor_pose(bodies, motion, world))


@wp.func
def body_way(
    episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, world: int, index: int, command: int
) -> wp.vec3:
    """Vector from a body to its relative reference, in the world frame [m]."""
    frame = frame_of(episodes, motion, world, command)
    wanted = relative_reference(bodies, motion, world, frame, index)
    return wp.transform_get_translation(wanted) - body_position_of(bodies, world, motion.bodies[index])


@wp.func
def body_turn_error(
    episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, world: int, index: int, command: int
) -> float:
    """Angle between a body and its relative reference [rad]."""
    frame = frame_of(episodes, motion, world, command)
    wanted = wp.transform_get_rotation(relative_reference(bodies, motion, world, frame, index))
    return quaternion_error(wanted, body_rotation_of(bodies, world, motion.bodies[index]))


@wp.func
def anchor_turn_error(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> float:
    """Angle between the robot's anchor and the motion's, in [0, pi] [rad].

    mjlab: error_anchor_rot (of MotionCommand). Isaac Lab: error_anchor_rot (of BeyondMimic's MotionCommand).
    """
    wanted = wp.transform_get_rotation(wanted_anchor(motion, frame_of(episodes, motion, world, command)))
    return quaternion_error(wanted, wp.transform_get_rotation(anchor_pose(bodies, motion, world)))


@wp.func
def anchor_distance(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> float:
    """Distance between the robot's anchor and the motion's [m].

    mjlab: error_anchor_pos (of MotionCommand). Isaac Lab: error_anchor_pos (of BeyondMimic's MotionCommand).
    """
    return wp.length(anchor_way(episodes, bodies, motion, world, command))


@wp.func
def follow_anchor_position(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, std: float
) -> float:
    """exp(-d^2 / std^2), d the distance between the robot's anchor and the motion's [m].

    mjlab: motion_global_anchor_position_error_exp. Isaac Lab: motion_global_anchor_position_error_exp (of BeyondMimic).
    """
    return wp.exp(-wp.length_sq(anchor_way(episodes, bodies, motion, world, command)) / (std * std))


@wp.func
def follow_anchor_turn(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, std: float
) -> float:
    """exp(-a^2 / std^2), a the angle between the robot's anchor and the motion's [rad].

    mjlab: motion_global_anchor_orientation_error_exp. Isaac Lab: motion_global_anchor_orientation_error_exp (of BeyondMimic).
    """
    angle = anchor_turn_error(world, episodes, bodies, motion, command)
    return wp.exp(-angle * angle / (std * std))


@wp.func
def likeness(motion: MotionArrays, total: float, std: float) -> float:
    """exp(-mean / std^2) of squared errors of the motion's bodies, given their ``total``."""
    return wp.exp(-total / (float(motion.bodies.shape[0]) * std * std))


@wp.func
def follow_body_positions(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, std: float
) -> float:
    """exp(-mean of d^2 / std^2), d the distance of each body from its relative reference [m].

    mjlab: motion_relative_body_position_error_exp. Isaac Lab: motion_relative_body_position_error_exp (of BeyondMimic).
    """
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        total += wp.length_sq(body_way(episodes, bodies, motion, world, index, command))
    return likeness(motion, total, std)


@wp.func
def follow_body_turns(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, std: float
) -> float:
    """exp(-mean of a^2 / std^2), a the angle of each body from its relative reference [rad].

    mjlab: motion_relative_body_orientation_error_exp. Isaac Lab: motion_relative_body_orientation_error_exp (of BeyondMimic).
    """
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        angle = body_turn_error(episodes, bodies, motion, world, index, command)
        total += angle * angle
    return likeness(motion, total, std)


@wp.func
def follow_body_velocities(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, std: float
) -> float:
    """exp(-mean of e^2 / std^2), e the difference of each body's velocity from the motion's, both of its origin in the world frame [m/s].

    mjlab: motion_global_body_linear_velocity_error_exp. Isaac Lab: motion_global_body_linear_velocity_error_exp (of BeyondMimic).
    """
    frame = frame_of(episodes, motion, world, command)
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        velocity = body_origin_velocity(bodies, world, motion.bodies[index])
        total += wp.length_sq(velocity - motion.linear[frame, index])
    return likeness(motion, total, std)


@wp.func
def follow_body_turning(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, std: float
) -> float:
    """exp(-mean of e^2 / std^2), e the difference of each body's angular velocity from the motion's, in the world frame [rad/s].

    mjlab: motion_global_body_angular_velocity_error_exp. Isaac Lab: motion_global_body_angular_velocity_error_exp (of BeyondMimic).
    """
    frame = frame_of(episodes, motion, world, command)
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        turning = body_turning(bodies, world, motion.bodies[index])
        total += wp.length_sq(turning - motion.angular[frame, index])
    return likeness(motion, total, std)


@wp.func
def anchor_too_far(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, limit: float
) -> bool:
    """Whether the robot's anchor is more than ``limit`` from the motion's [m].

    mjlab: bad_anchor_pos. Isaac Lab: bad_anchor_pos (of BeyondMimic).
    """
    return anchor_distance(world, episodes, bodies, motion, command) > limit


@wp.func
def anchor_height_off(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, limit: float
) -> bool:
    """Whether the robot's anchor is more than ``limit`` above or below the motion's [m].

    mjlab: bad_anchor_pos_z_only. Isaac Lab: bad_anchor_pos_z_only (of BeyondMimic).
    """
    return wp.abs(anchor_way(episodes, bodies, motion, world, command)[2]) > limit


@wp.func
def anchor_tilt_off(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, limit: float
) -> bool:
    """Whether the cosines of the tilts of both anchors differ by more than ``limit``.

    mjlab: bad_anchor_ori. Isaac Lab: bad_anchor_ori (of BeyondMimic).
    """
    up = wp.vec3(0.0, 0.0, 1.0)
    wanted = wanted_anchor(motion, frame_of(episodes, motion, world, command))
    here = wp.transform_vector(anchor_pose(bodies, motion, world), up)[2]
    return wp.abs(here - wp.transform_vector(wanted, up)[2]) > limit


@wp.func
def followed_body_too_far(
    world: int,
    episodes: EpisodeArrays,
    bodies: BodyArrays,
    motion: MotionArrays,
    index: int,
    command: int,
    limit: float,
) -> bool:
    """Whether body ``index`` of the motion is more than ``limit`` from its relative reference [m].

    mjlab: bad_motion_body_pos. Isaac Lab: bad_motion_body_pos (of BeyondMimic).
    """
    return wp.length(body_way(episodes, bodies, motion, world, index, command)) > limit


@wp.func
def followed_body_height_off(
    world: int,
    episodes: EpisodeArrays,
    bodies: BodyArrays,
    motion: MotionArrays,
    index: int,
    command: int,
    limit: float,
) -> bool:
    """Whether body ``index`` of the motion is more than ``limit`` above or below its relative reference [m].

    mjlab: bad_motion_body_pos_z_only. Isaac Lab: bad_motion_body_pos_z_only (of BeyondMimic).
    """
    return wp.abs(body_way(episodes, bodies, motion, world, index, command)[2]) > limit


@wp.func
def mean_body_distance(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> float:
    """Mean distance of the bodies from their positions in the motion, in the world frame [m].

    mjlab: compute_mpkpe. Isaac Lab: -.
    """
    frame = frame_of(episodes, motion, world, command)
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        total += wp.length(motion.positions[frame, index] - body_position_of(bodies, world, motion.bodies[index]))
    return total / float(motion.bodies.shape[0])


@wp.func
def mean_relative_body_distance(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> float:
    """Mean distance of the bodies from their relative references [m].

    mjlab: compute_root_relative_mpkpe, compute_ee_position_error (of the end effectors alone). Isaac Lab: error_body_pos (of
    BeyondMimic's MotionCommand).
    """
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        total += wp.length(body_way(episodes, bodies, motion, world, index, command))
    return total / float(motion.bodies.shape[0])


@wp.func
def mean_relative_body_turn(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> float:
    """Mean angle of the bodies from their relative references [rad].

    mjlab: compute_ee_orientation_error (of the end effectors alone). Isaac Lab: error_body_rot (of BeyondMimic's MotionCommand).
    """
    total = float(0.0)
    for index in range(motion.bodies.shape[0]):
        total += body_turn_error(episodes, bodies, motion, world, index, command)
    return total / float(motion.bodies.shape[0])


@wp.func
def joint_position_error_norm(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, motion: MotionArrays, command: int
) -> float:
    """Root of the sum of squares of all joints' distances from the motion [m, rad].

    mjlab: error_joint_pos (of MotionCommand). Isaac Lab: error_joint_pos (of BeyondMimic's MotionCommand).
    """
    frame = frame_of(episodes, motion, world, command)
    total = float(0.0)
    for joint in range(robot.coordinates.shape[0]):
        error = motion.joint_positions[frame, joint] - worlds.joint_q[world, robot.coordinates[joint]]
        total += error * error
    return wp.sqrt(total)


@wp.func
def joint_velocity_error(
    world: int, worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, motion: MotionArrays, command: int
) -> float:
    """Root of the mean square of all joints' velocity errors [m/s, rad/s].

    mjlab: compute_joint_velocity_error. Isaac Lab: -.
    """
    frame = frame_of(episodes, motion, world, command)
    total = float(0.0)
    for joint in range(robot.dofs.shape[0]):
        error = motion.joint_velocities[frame, joint] - worlds.joint_qd[world, robot.dofs[joint]]
        total += error * error
    return wp.sqrt(total / float(robot.dofs.shape[0]))
