"""Tracking rewards: rewards, terminations and metrics for a robot that follows a recorded motion.

As in :mod:`worker.tasks.terms.more.tracking`, :func:`motion_command` draws the ``command``. Means are over all bodies or joints of the motion;
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
from worker.tasks.terms.composing import (
    above,
    composed,
    length,
    length_squared,
    likeness,
    likeness_of_mean,
    magnitude,
    mean,
    squared,
    vertical,
)
from worker.tasks.terms.more.motion import MotionArrays
from worker.tasks.terms.more.tracking import anchor_pose, frame_of, reference_anchor, relative_reference

wp.set_module_options({"enable_backward": False})


@wp.func
def _anchor_way(world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int) -> wp.vec3:
    """Vector from the robot's anchor to the motion's, in the world frame [m]."""
    reference = wp.transform_get_translation(reference_anchor(motion, frame_of(episodes, motion, world, command)))
    return reference - wp.transform_get_translation(anchor_pose(bodies, motion, world))


@wp.func
def _body_way(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, index: int, command: int
) -> wp.vec3:
    """Vector from a body to its relative reference, in the world frame [m]."""
    frame = frame_of(episodes, motion, world, command)
    reference = relative_reference(bodies, motion, world, frame, index)
    return wp.transform_get_translation(reference) - body_position_of(bodies, world, motion.bodies[index])


@wp.func
def _body_turn(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, index: int, command: int
) -> float:
    """Angle between a body and its relative reference [rad]."""
    frame = frame_of(episodes, motion, world, command)
    reference = wp.transform_get_rotation(relative_reference(bodies, motion, world, frame, index))
    return quaternion_error(reference, body_rotation_of(bodies, world, motion.bodies[index]))


@wp.func
def _body_way_in_world(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, index: int, command: int
) -> wp.vec3:
    """Vector from a body to its position in the motion, in the world frame [m]."""
    reference = motion.positions[frame_of(episodes, motion, world, command), index]
    return reference - body_position_of(bodies, world, motion.bodies[index])


@wp.func
def _body_velocity_error(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, index: int, command: int
) -> wp.vec3:
    """Difference of the velocity of a body's origin from the motion's, in the world frame [m/s]."""
    reference = motion.linear[frame_of(episodes, motion, world, command), index]
    return body_origin_velocity(bodies, world, motion.bodies[index]) - reference


@wp.func
def _body_turning_error(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, index: int, command: int
) -> wp.vec3:
    """Difference of a body's angular velocity from the motion's, in the world frame [rad/s]."""
    reference = motion.angular[frame_of(episodes, motion, world, command), index]
    return body_turning(bodies, world, motion.bodies[index]) - reference


@wp.func
def _joint_error(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    motion: MotionArrays,
    joint: int,
    command: int,
) -> float:
    """Difference of a joint's position in the motion from the robot's [m, rad]."""
    reference = motion.joint_positions[frame_of(episodes, motion, world, command), joint]
    return reference - worlds.joint_q[world, robot.coordinates[joint]]


@wp.func
def _joint_velocity_error(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    motion: MotionArrays,
    joint: int,
    command: int,
) -> float:
    """Difference of a joint's velocity in the motion from the robot's [m/s, rad/s]."""
    reference = motion.joint_velocities[frame_of(episodes, motion, world, command), joint]
    return reference - worlds.joint_qd[world, robot.dofs[joint]]


@wp.func
def _root_of_sum(total: float, count: int) -> float:
    return wp.sqrt(total)


@wp.func
def _root_of_mean(total: float, count: int) -> float:
    return wp.sqrt(total / float(count))


@wp.func
def anchor_turn_error(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> float:
    """Angle between the robot's anchor and the motion's, in [0, pi] [rad].

    mjlab: error_anchor_rot (of MotionCommand). Isaac Lab: error_anchor_rot (of BeyondMimic's MotionCommand).
    """
    reference = wp.transform_get_rotation(reference_anchor(motion, frame_of(episodes, motion, world, command)))
    return quaternion_error(reference, wp.transform_get_rotation(anchor_pose(bodies, motion, world)))


@composed(length, _anchor_way)
def anchor_distance():
    """Distance between the robot's anchor and the motion's [m].

    mjlab: error_anchor_pos (of MotionCommand). Isaac Lab: error_anchor_pos (of BeyondMimic's MotionCommand).
    """


@composed(likeness, length_squared, _anchor_way)
def follow_anchor_position(std: float):
    """exp(-d^2 / std^2), d the distance between the robot's anchor and the motion's [m].

    mjlab: motion_global_anchor_position_error_exp. Isaac Lab: motion_global_anchor_position_error_exp (of BeyondMimic).
    """


@composed(likeness, squared, anchor_turn_error)
def follow_anchor_turn(std: float):
    """exp(-a^2 / std^2), a the angle between the robot's anchor and the motion's [rad].

    mjlab: motion_global_anchor_orientation_error_exp. Isaac Lab: motion_global_anchor_orientation_error_exp (of BeyondMimic).
    """


@composed(likeness_of_mean, length_squared, _body_way, sum_over="motion.bodies")
def follow_body_positions(std: float):
    """exp(-mean of d^2 / std^2), d the distance of each body from its relative reference [m].

    mjlab: motion_relative_body_position_error_exp. Isaac Lab: motion_relative_body_position_error_exp (of BeyondMimic).
    """


@composed(likeness_of_mean, squared, _body_turn, sum_over="motion.bodies")
def follow_body_turns(std: float):
    """exp(-mean of a^2 / std^2), a the angle of each body from its relative reference [rad].

    mjlab: motion_relative_body_orientation_error_exp. Isaac Lab: motion_relative_body_orientation_error_exp (of BeyondMimic).
    """


@composed(likeness_of_mean, length_squared, _body_velocity_error, sum_over="motion.bodies")
def follow_body_velocities(std: float):
    """exp(-mean of e^2 / std^2), e the difference of each body's velocity from the motion's, both of its origin in the world frame [m/s].

    mjlab: motion_global_body_linear_velocity_error_exp. Isaac Lab: motion_global_body_linear_velocity_error_exp (of
    BeyondMimic).
    """


@composed(likeness_of_mean, length_squared, _body_turning_error, sum_over="motion.bodies")
def follow_body_turning(std: float):
    """exp(-mean of e^2 / std^2), e the difference of each body's angular velocity from the motion's, in the world frame [rad/s].

    mjlab: motion_global_body_angular_velocity_error_exp. Isaac Lab: motion_global_body_angular_velocity_error_exp (of
    BeyondMimic).
    """


@composed(above, anchor_distance)
def anchor_too_far(limit: float):
    """Whether the robot's anchor is more than ``limit`` from the motion's [m].

    mjlab: bad_anchor_pos. Isaac Lab: bad_anchor_pos (of BeyondMimic).
    """


@composed(above, magnitude, vertical, _anchor_way)
def anchor_height_off(limit: float):
    """Whether the robot's anchor is more than ``limit`` above or below the motion's [m].

    mjlab: bad_anchor_pos_z_only. Isaac Lab: bad_anchor_pos_z_only (of BeyondMimic).
    """


@wp.func
def anchor_tilt_off(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int, limit: float
) -> bool:
    """Whether the cosines of the tilts of both anchors differ by more than ``limit``.

    mjlab: bad_anchor_ori. Isaac Lab: bad_anchor_ori (of BeyondMimic).
    """
    up = wp.vec3(0.0, 0.0, 1.0)
    reference = reference_anchor(motion, frame_of(episodes, motion, world, command))
    here = wp.transform_vector(anchor_pose(bodies, motion, world), up)[2]
    return wp.abs(here - wp.transform_vector(reference, up)[2]) > limit


@composed(above, length, _body_way)
def followed_body_too_far(limit: float):
    """Whether body ``index`` of the motion is more than ``limit`` from its relative reference [m].

    mjlab: bad_motion_body_pos. Isaac Lab: bad_motion_body_pos (of BeyondMimic).
    """


@composed(above, magnitude, vertical, _body_way)
def followed_body_height_off(limit: float):
    """Whether body ``index`` of the motion is more than ``limit`` above or below its relative reference [m].

    mjlab: bad_motion_body_pos_z_only. Isaac Lab: bad_motion_body_pos_z_only (of BeyondMimic).
    """


@composed(mean, length, _body_way_in_world, sum_over="motion.bodies")
def mean_body_distance():
    """Mean distance of the bodies from their positions in the motion, in the world frame [m]. mjlab: compute_mpkpe."""


@composed(mean, length, _body_way, sum_over="motion.bodies")
def mean_relative_body_distance():
    """Mean distance of the bodies from their relative references [m].

    mjlab: compute_root_relative_mpkpe, compute_ee_position_error (of the end effectors alone). Isaac Lab: error_body_pos (of
    BeyondMimic's MotionCommand).
    """


@composed(mean, _body_turn, sum_over="motion.bodies")
def mean_relative_body_turn():
    """Mean angle of the bodies from their relative references [rad].

    mjlab: compute_ee_orientation_error (of the end effectors alone). Isaac Lab: error_body_rot (of BeyondMimic's
    MotionCommand).
    """


@composed(_root_of_sum, squared, _joint_error, sum_over="robot.coordinates")
def joint_position_error_norm():
    """Root of the sum of squares of all joints' distances from the motion [m, rad].

    mjlab: error_joint_pos (of MotionCommand). Isaac Lab: error_joint_pos (of BeyondMimic's MotionCommand).
    """


@composed(_root_of_mean, squared, _joint_velocity_error, sum_over="robot.dofs")
def joint_velocity_error():
    """Root of the mean square of all joints' velocity errors [m/s, rad/s]. mjlab: compute_joint_velocity_error."""
