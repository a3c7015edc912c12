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

    mjlab, Isaac Lab: JointEffortAction.
    """
    worlds.controls[world, robot.actuators[joint]] = value


@needs(kind="position")
@wp.func
def position_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """A position target in the encoder's coordinates: the actuator's target is ``value`` minus the encoder's bias [m, rad].

    mjlab: JointPositionAction. Isaac Lab: JointPositionAction (without a bias).
    """
    aim(worlds, robot, world, joint, value)


@needs(kind="velocity")
@wp.func
def velocity_target(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    """The target of a <velocity> actuator is ``value`` [m/s, rad/s]. mjlab, Isaac Lab: JointVelocityAction."""
    worlds.controls[world, robot.actuators[joint]] = value


@needs(kind="position")
@wp.func
def move_frame(world: int, ik: IkArrays, index: int, value: float):
    """A displacement of a body or site by ``value`` along or about one axis [m, rad], or one number of its wanted pose.

    The ``DifferentialIK`` decides which of both and which axes, and computes position targets once per control step. A displacement
    starts at the pose at the control step's start; a pose is a position [m] and a quaternion xyzw.

    mjlab: DifferentialIKAction (which solves in every physics step, and takes quaternions wxyz). Isaac Lab:
    DifferentialInverseKinematicsAction (which solves in every physics step, and takes quaternions wxyz).
    """
    ik.target[world, index] = value


@wp.func
def last_action(world: int, episodes: EpisodeArrays, action: int) -> float:
    """The action that led to this observation, unclipped; 0 after a reset. mjlab, Isaac Lab: last_action."""
    return episodes.last_actions[world, action]


@wp.func
def clipped_last_action(world: int, episodes: EpisodeArrays, action: int, limit: float = 1.0) -> float:
    """The action that led to this observation, clipped to +- ``limit``, beyond which it had no effect on the robot; 0 after a reset."""
    return wp.clamp(episodes.last_actions[world, action], -limit, limit)


@wp.func
def action_squared(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Square of an action. Isaac Lab: action_l2."""
    return episodes.actions[world, action] * episodes.actions[world, action]


@wp.func
def action_rate_squared(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Square of the change of an action since the previous step, both unclipped. mjlab, Isaac Lab: action_rate_l2."""
    change = episodes.actions[world, action] - episodes.last_actions[world, action]
    return change * change


@wp.func
def action_acceleration(world: int, episodes: EpisodeArrays, action: int) -> float:
    """a - 2 b + c, with an action a, the previous one b and the one before that c."""
    before = episodes.last_actions[world, action]
    return episodes.actions[world, action] - 2.0 * before + episodes.earlier_actions[world, action]


@wp.func
def mean_action_acceleration(world: int, episodes: EpisodeArrays, action: int) -> float:
    """|a - 2 b + c| over the number of actions: summed over all actions, their mean jerk. mjlab: mean_action_acc."""
    return wp.abs(action_acceleration(world, episodes, action)) / float(episodes.actions.shape[1])
