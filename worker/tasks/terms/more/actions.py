"""Actions: further kinds of targets, and costs."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.actions import action_acceleration, aim
from worker.tasks.terms.composing import composed, squared
from worker.tasks.terms.placing import within_limits

wp.set_module_options({"enable_backward": False})


@needs(kind="effort")
@wp.func
def limited_effort(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A share of the greatest force or torque on the joint, ``value`` in [-1, 1]; without a limit, ``value`` itself [N, N m].

    It is for a <motor>, whose input is the force over its gear and gain.
    """
    greatest = robot.efforts[joint]
    if not wp.isfinite(greatest):
        greatest = 1.0
    worlds.controls[world, robot.actuators[joint]] = greatest * wp.clamp(value, -1.0, 1.0) / robot.gains[joint]


@needs(kind="position", some_ranges=True)
@wp.func
def limited_position_target(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float, soft_factor: float = 1.0
):
    """A position target as :func:`position_target`, kept within ``soft_factor`` times the joint's range about its middle [m, rad]."""
    aim(worlds, robot, world, joint, within_limits(robot, joint, value, soft_factor))


@needs(kind="position")
@wp.func
def relative_position_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A relative position target: the joint's position at the control step's start + ``value`` [m, rad].

    mjlab: RelativeJointPositionAction (which adds to the position in every physics step). Isaac Lab:
    RelativeJointPositionAction (as mjlab's).
    """
    here = worlds.joint_q[world, robot.coordinates[joint]]
    worlds.controls[world, robot.actuators[joint]] = here + value + robot.references[joint]


@needs(kind="position", ranges=True)
@wp.func
def share_of_range_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A position target between the joint's limits: ``value`` -1 is the lower, 1 the upper; clipped. The joint must have limits.

    Isaac Lab: JointPositionToLimitsAction.
    """
    ends = robot.ranges[joint]
    share = wp.clamp(value, -1.0, 1.0)
    aim(worlds, robot, world, joint, 0.5 * (ends[0] + ends[1]) + 0.5 * share * (ends[1] - ends[0]))


@needs(kind="position", memory_each=2)
@wp.func
def smoothed_position_target(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    joint: int,
    value: float,
    memory: int,
    share: float,
):
    """A position target that follows ``value`` slowly: t = share * value + (1 - share) * t of the step before [m, rad].

    The first target of an episode is where the joint is.

    Isaac Lab: EMAJointPositionToLimitsAction (without its scaling to the limits).
    """
    column = memory + 2 * joint
    before = episodes.memory[world, column]
    if episodes.memory[world, column + 1] == 0.0:
        before = worlds.joint_q[world, robot.coordinates[joint]] + robot.encoder_bias[world, joint]
    target = share * value + (1.0 - share) * before
    episodes.memory[world, column] = target
    episodes.memory[world, column + 1] = 1.0
    aim(worlds, robot, world, joint, target)


@needs(kind="position")
@wp.func
def two_positions_target(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float, closed: float, opened: float
):
    """One of two position targets, as of a gripper: ``closed`` where ``value`` is negative, else ``opened`` [m, rad].

    Isaac Lab: BinaryJointPositionAction.
    """
    aim(worlds, robot, world, joint, wp.where(value < 0.0, closed, opened))


@needs(kind="velocity")
@wp.func
def two_velocities_target(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float, closing: float, opening: float
):
    """One of two velocity targets: ``closing`` where ``value`` is negative, else ``opening`` [m/s, rad/s].

    Isaac Lab: BinaryJointVelocityAction.
    """
    worlds.controls[world, robot.actuators[joint]] = wp.where(value < 0.0, closing, opening)


@wp.func
def action_magnitude(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Magnitude of an action."""
    return wp.abs(episodes.actions[world, action])


@wp.func
def action_excess(world: int, episodes: EpisodeArrays, action: int, limit: float = 1.0) -> float:
    """Distance of an action beyond ``limit`` on either side, where clipping hides the policy's output."""
    return wp.max(wp.abs(episodes.actions[world, action]) - limit, 0.0)


@composed(squared, action_acceleration)
def action_acceleration_squared():
    """Square of a - 2 b + c, with an action a, the previous one b and the one before that c. mjlab: action_acc_l2."""
