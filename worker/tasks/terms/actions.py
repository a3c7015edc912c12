"""Actions: their effect on the actuators, observations of them, and costs of their changes.

An action function is called for one joint with ``value``, offset + scale * action, and writes the input of that joint's actuator; or for
one column of a ``DifferentialIK``, which moves a frame of the robot and writes the inputs of all its joints. It runs once per control
step, and the input holds for all physics steps.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.ik_kernels import IkArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs

wp.set_module_options({"enable_backward": False})


@wp.func
def aim(worlds: WorldArrays, robot: RobotArrays, world: int, joint: int, target: float):
    """Write a position target, in the encoder's coordinates, to a joint's actuator [m, rad]."""
    worlds.controls[world, robot.actuators[joint]] = target - robot.encoder_bias[world, joint] + robot.references[joint]


@needs(kind="effort")
@wp.func
def effort(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A force or torque: the input of a <motor> is ``value`` [N, N m, times its gear].

    mjlab: JointEffortAction. Isaac Lab: JointEffortAction.
    """
    worlds.controls[world, robot.actuators[joint]] = value


@needs(kind="effort")
@wp.func
def limited_effort(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A share of the greatest force or torque on the joint, ``value`` in [-1, 1]; without a limit, ``value`` itself [N, N m].

    It is for a <motor>, whose input is the force over its gear and gain.

    mjlab: -. Isaac Lab: -.
    """
    greatest = robot.efforts[joint]
    if not wp.isfinite(greatest):
        greatest = 1.0
    worlds.controls[world, robot.actuators[joint]] = greatest * wp.clamp(value, -1.0, 1.0) / robot.gains[joint]


@needs(kind="position")
@wp.func
def position_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A position target in the encoder's coordinates: the actuator's target is ``value`` minus the encoder's bias [m, rad].

    mjlab: JointPositionAction. Isaac Lab: JointPositionAction (without a bias).
    """
    aim(worlds, robot, world, joint, value)


@needs(kind="position", some_ranges=True)
@wp.func
def limited_position_target(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float, soft_factor: float = 1.0
):
    """A position target as :func:`position_target`, kept within ``soft_factor`` times the joint's range about its middle [m, rad].

    mjlab: -. Isaac Lab: -.
    """
    ends = robot.ranges[joint]
    margin = 0.5 * (1.0 - soft_factor) * (ends[1] - ends[0])
    if not wp.isfinite(margin):
        margin = 0.0
    aim(worlds, robot, world, joint, wp.clamp(value, ends[0] + margin, ends[1] - margin))


@needs(kind="position")
@wp.func
def relative_position_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A relative position target: the joint's position at the control step's start + ``value`` [m, rad].

    mjlab: RelativeJointPositionAction (which adds to the position in every physics step). Isaac Lab: RelativeJointPositionAction (as
    mjlab's).
    """
    here = worlds.joint_q[world, robot.coordinates[joint]]
    worlds.controls[world, robot.actuators[joint]] = here + value + robot.references[joint]


@needs(kind="position", ranges=True)
@wp.func
def share_of_range_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A position target between the joint's limits: ``value`` -1 is the lower, 1 the upper; clipped. The joint must have limits.

    mjlab: -. Isaac Lab: JointPositionToLimitsAction.
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

    mjlab: -. Isaac Lab: EMAJointPositionToLimitsAction (without its scaling to the limits).
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

    mjlab: -. Isaac Lab: BinaryJointPositionAction.
    """
    aim(worlds, robot, world, joint, wp.where(value < 0.0, closed, opened))


@needs(kind="velocity")
@wp.func
def velocity_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A velocity: the target of a <velocity> actuator is ``value`` [m/s, rad/s].

    mjlab: JointVelocityAction. Isaac Lab: JointVelocityAction.
    """
    worlds.controls[world, robot.actuators[joint]] = value


@needs(kind="velocity")
@wp.func
def two_velocities_target(
    world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float, closing: float, opening: float
):
    """One of two velocity targets: ``closing`` where ``value`` is negative, else ``opening`` [m/s, rad/s].

    mjlab: -. Isaac Lab: BinaryJointVelocityAction.
    """
    worlds.controls[world, robot.actuators[joint]] = wp.where(value < 0.0, closing, opening)


@needs(kind="position")
@wp.func
def move_frame(world: int, ik: IkArrays, index: int, value: float):
    """A displacement of a body or site by ``value`` along or about one axis [m, rad], or one number of its wanted pose.

    The ``DifferentialIK`` decides which of both and which axes, and computes position targets once per control step. A displacement
    starts at the pose at the control step's start; a pose is a position [m] and a quaternion xyzw.

    mjlab: DifferentialIKAction (which solves in every physics step, and takes quaternions wxyz).
    Isaac Lab: DifferentialInverseKinematicsAction (which solves in every physics step, and takes quaternions wxyz).
    """
    ik.wanted[world, index] = value


@wp.func
def last_action(world: int, episodes: EpisodeArrays, action: int) -> float:
    """The action that led to this observation, unclipped; 0 after a reset.

    mjlab: last_action. Isaac Lab: last_action.
    """
    return episodes.last_actions[world, action]


@wp.func
def clipped_last_action(world: int, episodes: EpisodeArrays, action: int, limit: float = 1.0) -> float:
    """The action that led to this observation, clipped to +- ``limit``, beyond which it had no effect on the robot; 0 after a reset.

    mjlab: -. Isaac Lab: -.
    """
    return wp.clamp(episodes.last_actions[world, action], -limit, limit)


@wp.func
def action_squared(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Square of an action.

    mjlab: -. Isaac Lab: action_l2.
    """
    return episodes.actions[world, action] * episodes.actions[world, action]


@wp.func
def action_magnitude(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Magnitude of an action.

    mjlab: -. Isaac Lab: -.
    """
    return wp.abs(episodes.actions[world, action])


@wp.func
def action_excess(world: int, episodes: EpisodeArrays, action: int, limit: float = 1.0) -> float:
    """Distance of an action beyond ``limit`` on either side, where clipping hides the policy's output.

    mjlab: -. Isaac Lab: -.
    """
    return wp.max(wp.abs(episodes.actions[world, action]) - limit, 0.0)


@wp.func
def action_rate_squared(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Square of the change of an action since the previous step, both unclipped.

    mjlab: action_rate_l2. Isaac Lab: action_rate_l2.
    """
    change = episodes.actions[world, action] - episodes.last_actions[world, action]
    return change * change


@wp.func
def action_acceleration(world: int, episodes: EpisodeArrays, action: int) -> float:
    """a - 2 b + c, with an action a, the previous one b and the one before that c.

    mjlab: -. Isaac Lab: -.
    """
    before = episodes.last_actions[world, action]
    return episodes.actions[world, action] - 2.0 * before + episodes.earlier_actions[world, action]


@wp.func
def action_acceleration_squared(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Square of a - 2 b + c, with an action a, the previous one b and the one before that c.

    mjlab: action_acc_l2. Isaac Lab: -.
    """
    change = action_acceleration(world, episodes, action)
    return change * change


@wp.func
def mean_action_acceleration(world: int, episodes: EpisodeArrays, action: int) -> float:
    """|a - 2 b + c| over the number of actions: summed over all actions, their mean jerk.

    mjlab: mean_action_acc. Isaac Lab: -.
    """
    return wp.abs(action_acceleration(world, episodes, action)) / float(episodes.actions.shape[1])
