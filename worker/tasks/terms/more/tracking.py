"""Tracking: observations and commands of a robot that follows a recorded motion.

The motion is declared as :class:`worker.tasks.terms.Motion` among the sensors. :func:`motion_command` draws the ``command``, one number:
the frame. The anchor is one of the tracked bodies. A body's relative reference is its pose in the motion, carried over to the robot's
anchor: moved along x and y and turned about the vertical, so that drift in these doesn't count.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import (
    body_position_of,
    body_rotation_of,
    quaternion_from_angles,
    set_root_pose,
    set_root_velocity,
    turn_element,
    yaw_quaternion,
)
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.more.frame_sampling import drawn_frame
from worker.tasks.terms.more.motion import MotionArrays
from worker.tasks.terms.placing import between, set_joint, within_limits

wp.set_module_options({"enable_backward": False})


_NONE = wp.constant(wp.vec3(0.0, 0.0, 0.0))
"""Half widths of numbers that are not drawn."""


@wp.func
def frame_of(episodes: EpisodeArrays, motion: MotionArrays, world: int, command: int) -> int:
    """Present frame of a world; it stays at the last one."""
    return wp.clamp(int(episodes.memory[world, command]), 0, motion.roots.shape[0] - 1)


@wp.func
def anchor_pose(bodies: BodyArrays, motion: MotionArrays, world: int) -> wp.transform:
    """Pose of the robot's anchor, in the world frame."""
    return bodies.poses[world, motion.bodies[motion.anchor]]


@wp.func
def reference_anchor(motion: MotionArrays, frame: int) -> wp.transform:
    """Pose of the motion's anchor, in the world frame."""
    return wp.transform(motion.positions[frame, motion.anchor], motion.rotations[frame, motion.anchor])


@wp.func
def relative_reference(bodies: BodyArrays, motion: MotionArrays, world: int, frame: int, index: int) -> wp.transform:
    """Relative reference of a body, in the world frame, with the motion's height of the anchor."""
    anchor, reference = anchor_pose(bodies, motion, world), reference_anchor(motion, frame)
    between_both = wp.transform_get_rotation(anchor) * wp.quat_inverse(wp.transform_get_rotation(reference))
    turn = yaw_quaternion(between_both)
    place = wp.transform_get_translation(anchor)
    origin = wp.transform_get_translation(reference)
    place = wp.vec3(place[0], place[1], origin[2])
    position = place + wp.quat_rotate(turn, motion.positions[frame, index] - origin)
    return wp.transform(position, turn * motion.rotations[frame, index])


@wp.func
def sampled(stream: wp.uint32, first: int, half: wp.vec3) -> wp.vec3:
    """Three numbers, each evenly from plus and minus its half width."""
    return wp.vec3(
        between(stream, first, wp.vec2(-half[0], half[0])),
        between(stream, first + 1, wp.vec2(-half[1], half[1])),
        between(stream, first + 2, wp.vec2(-half[2], half[2])),
    )


@needs(command=1)
@wp.func
def motion_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    motion: MotionArrays,
    command: int,
    stream: wp.uint32,
    from_start: bool = False,
    position: wp.vec3 = _NONE,
    turn: wp.vec3 = _NONE,
    velocity: wp.vec3 = _NONE,
    turning: wp.vec3 = _NONE,
    joints: float = 0.0,
    soft_factor: float = 1.0,
):
    """Draw a frame of the motion by its ``sampling``, or take the first, and place the robot accordingly; 1 number.

    The pose and velocities of the root and the joints' positions are those of the frame plus numbers drawn evenly from plus and minus
    ``position`` [m], ``turn`` (roll, pitch, yaw, about the world's axes) [rad], ``velocity`` [m/s], ``turning`` [rad/s] and ``joints`` [m, rad]. Joints
    stay within ``soft_factor`` times their range. Declare it with ``update=Term(terms.advance_motion)`` and a duration longer than an
    episode.

    mjlab: MotionCommand (sampling_mode "adaptive", "uniform" or "start"). Isaac Lab: MotionCommand (of BeyondMimic).
    """
    frames = motion.roots.shape[0]
    frame = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    if not from_start:
        frame = drawn_frame(episodes, motion.sampling, world, frames, stream, 13 + robot.defaults.shape[0])
    episodes.memory[world, command] = float(frame)
    place = wp.transform_get_translation(motion.roots[frame]) + sampled(stream, 1, position)
    angles = sampled(stream, 4, turn)
    rotation = quaternion_from_angles(angles[0], angles[1], angles[2]) * wp.transform_get_rotation(motion.roots[frame])
    set_root_pose(worlds, robot, world, wp.transform(place, rotation))
    linear = motion.root_linear[frame] + sampled(stream, 7, velocity)
    angular = motion.root_angular[frame] + sampled(stream, 10, turning)
    set_root_velocity(worlds, robot, bodies, world, linear, angular)
    for joint in range(robot.defaults.shape[0]):
        offset = between(stream, 13 + joint, wp.vec2(-joints, joints))
        target = within_limits(robot, joint, motion.joint_positions[frame, joint] + offset, soft_factor)
        set_joint(worlds, robot, world, joint, target, motion.joint_velocities[frame, joint])


@needs(command=1)
@wp.func
def advance_motion(world: int, episodes: EpisodeArrays, motion: MotionArrays, command: int):
    """Advance by the frames of one control step; after the last frame :func:`motion_over` is true.

    mjlab: MotionCommand (which starts again elsewhere after the last frame). Isaac Lab: MotionCommand (of BeyondMimic, as
    mjlab's).
    """
    episodes.memory[world, command] = episodes.memory[world, command] + motion.rate
    motion.sampling.frames[world] = episodes.memory[world, command]


@wp.func
def evenness_of_frames(world: int, motion: MotionArrays) -> float:
    """Evenness of the start parts of episodes, from 0 to 1: the entropy of the sampling over its maximum.

    mjlab: MotionCommand (its metric sampling_entropy). Isaac Lab: MotionCommand (of BeyondMimic, its metric sampling_entropy).
    """
    return motion.sampling.evenness[0]


@wp.func
def motion_over(world: int, episodes: EpisodeArrays, motion: MotionArrays, command: int) -> bool:
    """Whether the motion is over; use it as a time-out."""
    return episodes.memory[world, command] >= float(motion.roots.shape[0])


@wp.func
def wanted_joint_position(world: int, episodes: EpisodeArrays, motion: MotionArrays, joint: int, command: int) -> float:
    """Joint position in the motion [m, rad].

    mjlab, Isaac Lab: generated_commands (of MotionCommand, its first half).
    """
    return motion.joint_positions[frame_of(episodes, motion, world, command), joint]


@wp.func
def wanted_joint_velocity(world: int, episodes: EpisodeArrays, motion: MotionArrays, joint: int, command: int) -> float:
    """Joint velocity in the motion [m/s, rad/s].

    mjlab, Isaac Lab: generated_commands (of MotionCommand, its second half).
    """
    return motion.joint_velocities[frame_of(episodes, motion, world, command), joint]


@wp.func
def wanted_anchor_position(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, command: int
) -> wp.vec3:
    """Position of the motion's anchor in the frame of the robot's anchor [m].

    mjlab: motion_anchor_pos_b. Isaac Lab: motion_anchor_pos_b (of BeyondMimic).
    """
    reference = reference_anchor(motion, frame_of(episodes, motion, world, command))
    return wp.transform_point(
        wp.transform_inverse(anchor_pose(bodies, motion, world)), wp.transform_get_translation(reference)
    )


@needs(size=6)
@wp.func
def wanted_anchor_turn(
    world: int, episodes: EpisodeArrays, bodies: BodyArrays, motion: MotionArrays, index: int, command: int
) -> float:
    """Element ``index``, one of six, of the first two columns of the matrix that turns the motion's anchor to the robot's, row by row.

    mjlab: motion_anchor_ori_b. Isaac Lab: motion_anchor_ori_b (of BeyondMimic).
    """
    reference = wp.transform_get_rotation(reference_anchor(motion, frame_of(episodes, motion, world, command)))
    robot_turn = wp.transform_get_rotation(anchor_pose(bodies, motion, world))
    return turn_element(wp.quat_inverse(robot_turn) * reference, index)


@wp.func
def followed_body_position(world: int, bodies: BodyArrays, motion: MotionArrays, index: int) -> wp.vec3:
    """Position of body ``index`` of the motion in the frame of the robot's anchor [m].

    mjlab: robot_body_pos_b. Isaac Lab: robot_body_pos_b (of BeyondMimic).
    """
    here = body_position_of(bodies, world, motion.bodies[index])
    return wp.transform_point(wp.transform_inverse(anchor_pose(bodies, motion, world)), here)


@needs(each=6)
@wp.func
def followed_body_turn(world: int, bodies: BodyArrays, motion: MotionArrays, index: int) -> float:
    """Element ``index % 6`` of the first two columns of the matrix of body ``index // 6`` in the frame of the robot's anchor, row by row.

    mjlab: robot_body_ori_b. Isaac Lab: robot_body_ori_b (of BeyondMimic).
    """
    rotation = body_rotation_of(bodies, world, motion.bodies[index // 6])
    anchor = wp.transform_get_rotation(anchor_pose(bodies, motion, world))
    return turn_element(wp.quat_inverse(anchor) * rotation, index % 6)
