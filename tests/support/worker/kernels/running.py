"""Robots with a torso and hinges that run along +x, with the observations and rewards known from Isaac Gym's Ant and Humanoid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import newton
import newton.examples
import numpy as np
import warp as wp

from worker.simulation.episodes import (
    STEP,
    EpisodeArrays,
    add_reward,
    begin_episode,
    clear_row,
    clipped_action,
    end_step,
    random_stream,
)
from worker.simulation.worlds import FIRST_COORDINATE, FIRST_DOF, WorldArrays, is_sound, root_rotation, root_velocities
from worker.tasks.interface import Interface, Observation, motor
from worker.tasks.task import Task

wp.set_module_options({"enable_backward": False})

TORSO = wp.constant(11)
"""Observations of the torso; three of each joint follow them."""


@wp.struct
class RunnerParameters:
    """The fields of :class:`RunningConfig` that the kernels use, and what the model says of each joint."""

    fall_height: float
    start_height: float
    start_angle_noise: float
    start_velocity_noise: float
    velocity_scale: float
    angular_velocity_scale: float
    ranges: wp.array[wp.vec2]
    """Lower and upper end of each joint's range [rad], shape ``(joints,)``."""
    strengths: wp.array[wp.float32]
    """Full torque of each joint's motor over that of the strongest, shape ``(joints,)``."""
    actuators: wp.array[wp.int32]
    """Index of each joint's motor, shape ``(joints,)``."""
    pose: wp.array[wp.float32]
    """Angle of each joint at the start, before noise [rad], shape ``(joints,)``."""


@wp.func
def scaled_position(parameters: RunnerParameters, worlds: WorldArrays, world: int, joint: int) -> float:
    """Joint angle mapped so that its range becomes [-1, 1]."""
    ends = parameters.ranges[joint]
    return (2.0 * worlds.joint_q[world, FIRST_COORDINATE + joint] - ends[0] - ends[1]) / (ends[1] - ends[0])


@wp.kernel
def act(parameters: RunnerParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """The action is each motor's share of its full torque, clipped to [-1, 1]."""
    world = wp.tid()
    for joint in range(parameters.actuators.shape[0]):
        worlds.controls[world, parameters.actuators[joint]] = clipped_action(episodes, world, joint)


@wp.func
def write_observation(
    observations: wp.array2d[wp.float32],
    parameters: RunnerParameters,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    world: int,
    first_step: bool,
):
    """Torso height, velocities in the torso frame, attitude, then joints, then the action that led here."""
    rotation = root_rotation(worlds, world)
    linear, angular = root_velocities(worlds, world)
    angular = angular * parameters.angular_velocity_scale
    forward = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))
    left = wp.quat_rotate(rotation, wp.vec3(0.0, 1.0, 0.0))
    up = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))
    observations[world, 0] = worlds.joint_q[world, 2]
    for axis in range(3):
        observations[world, 1 + axis] = linear[axis]
        observations[world, 4 + axis] = angular[axis]
    observations[world, 7] = wp.atan2(forward[1], forward[0])
    observations[world, 8] = wp.atan2(left[2], up[2])
    observations[world, 9] = up[2]
    observations[world, 10] = forward[0]
    joints = parameters.ranges.shape[0]
    for joint in range(joints):
        observations[world, TORSO + joint] = scaled_position(parameters, worlds, world, joint)
        velocity = worlds.joint_qd[world, FIRST_DOF + joint] * parameters.velocity_scale
        observations[world, TORSO + joints + joint] = velocity
        action = float(0.0)
        if not first_step:
            action = clipped_action(episodes, world, joint)
        observations[world, TORSO + 2 * joints + joint] = action


@wp.func
def place(parameters: RunnerParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Stand a world's robot at the origin facing +x, joints near their usual pose."""
    stream = random_stream(episodes, world)
    clear_row(worlds.joint_q, world)
    clear_row(worlds.joint_qd, world)
    worlds.joint_q[world, 2] = parameters.start_height
    worlds.joint_q[world, 6] = 1.0
    for joint in range(parameters.ranges.shape[0]):
        ends = parameters.ranges[joint]
        angle = parameters.pose[joint] + parameters.start_angle_noise * wp.randf(stream, -1.0, 1.0)
        worlds.joint_q[world, FIRST_COORDINATE + joint] = wp.clamp(angle, ends[0], ends[1])
        worlds.joint_qd[world, FIRST_DOF + joint] = parameters.start_velocity_noise * wp.randf(stream, -1.0, 1.0)


@wp.func
def add_rewards(parameters: RunnerParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Every reward term of a step without a fall."""
    rotation = root_rotation(worlds, world)
    heading = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))[0]
    upright = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))[2]
    effort = float(0.0)
    energy = float(0.0)
    limits = float(0.0)
    for joint in range(parameters.ranges.shape[0]):
        action = clipped_action(episodes, world, joint)
        velocity = worlds.joint_qd[world, FIRST_DOF + joint] * parameters.velocity_scale
        # of what the policy asked for: beyond the motors' limits nothing else would hold it back from drifting away
        effort += episodes.actions[world, joint] * episodes.actions[world, joint]
        energy += wp.abs(action * velocity) * parameters.strengths[joint]
        into = (wp.abs(scaled_position(parameters, worlds, world, joint)) - 0.98) / 0.02
        limits += wp.clamp(into, 0.0, 1.0) * parameters.strengths[joint]
    add_reward(episodes, world, 0, worlds.joint_qd[world, 0])
    add_reward(episodes, world, 1, wp.min(heading / 0.8, 1.0))
    if upright > 0.93:
        add_reward(episodes, world, 2, 1.0)
    add_reward(episodes, world, 3, 1.0)
    add_reward(episodes, world, 4, effort)
    add_reward(episodes, world, 5, energy)
    add_reward(episodes, world, 6, limits)


@wp.kernel
def observe(mode: int, max_age: int, parameters: RunnerParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """Reward, termination, statistics, masked reset and observation of one world a thread."""
    world = wp.tid()
    restart = mode != STEP
    if mode == STEP:
        valid = is_sound(worlds, world)
        fallen = valid and worlds.joint_q[world, 2] < parameters.fall_height
        episodes.rewards[world] = 0.0
        if fallen:
            add_reward(episodes, world, 7, 1.0)
        elif valid:
            add_rewards(parameters, worlds, episodes, world)
        restart = end_step(episodes, worlds.overflow, world, fallen, valid, max_age)
        if restart:
            if valid:
                write_observation(episodes.terminal_observations, parameters, worlds, episodes, world, False)
            else:
                clear_row(episodes.terminal_observations, world)
    if restart:
        begin_episode(episodes, world)
        place(parameters, worlds, episodes, world)
    write_observation(episodes.observations, parameters, worlds, episodes, world, restart)


def observation_names(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Names of what :func:`write_observation` writes."""
    return (
        "torso_height",
        *(f"torso_velocity_{axis}" for axis in "xyz"),
        *(f"torso_angular_velocity_{axis}" for axis in "xyz"),
        "torso_yaw",
        "torso_roll",
        "torso_up",
        "torso_heading",
        *(f"{joint}_{kind}" for kind in ("position", "velocity", "previous_action") for joint in joints),
    )


class Running(Task):
    """A robot of one of Newton's bundled MJCF files that runs; a subclass names the file and sets its numbers."""

    parameters_type = RunnerParameters
    act: ClassVar[wp.Kernel] = act
    observe: ClassVar[wp.Kernel] = observe
    ground = True
    asset: ClassVar[str]
    """The file, by its name among Newton's assets: a torso on a free joint, hinges, a motor for each hinge."""
    start_pose: ClassVar[Mapping[str, float]] = {}
    """Angles at the start that are not zero, by joint [rad]."""

    def build(self, builder: newton.ModelBuilder) -> None:
        """The robot without the file's floor; its own parts do not collide with each other."""
        builder.add_mjcf(newton.examples.get_asset(self.asset), ignore_names=["floor"], enable_self_collisions=False)
        config: Any = self.config
        # Half under the ground, as some files have it, the solver would ask for more capacity than it ever needs.
        builder.joint_q[2] = config.start_height

    def read_model(self, parameters: Any) -> None:
        """Ranges, motors and strengths, joint by joint: the files list motors in another order than joints."""
        model, motors = self.worlds.solver.mj_model, self._motors()
        torques = model.actuator_gear[motors, 0]
        parameters.ranges = wp.array(model.jnt_range[1:], dtype=wp.vec2, device=self.device)
        parameters.strengths = wp.array(torques / torques.max(), dtype=wp.float32, device=self.device)
        parameters.actuators = wp.array(motors, dtype=wp.int32, device=self.device)
        parameters.pose = wp.array(self._pose(), dtype=wp.float32, device=self.device)

    def interface(self) -> Interface:
        """Joint angles as shares of their ranges; each motor's torque."""
        config: Any = self.config
        model = self.worlds.solver.mj_model
        torso = [Observation("torso_height", "m")]
        torso += [Observation(f"torso_velocity_{axis}", "m/s") for axis in "xyz"]
        torso += [
            Observation(f"torso_angular_velocity_{axis}", "rad/s", config.angular_velocity_scale) for axis in "xyz"
        ]
        torso += [Observation("torso_yaw", "rad"), Observation("torso_roll", "rad")]
        torso += [Observation("torso_up"), Observation("torso_heading")]
        joints = self.action_names
        ends = [tuple(map(float, pair)) for pair in model.jnt_range[1:]]
        middles = [(least + greatest) / 2.0 for least, greatest in ends]
        scales = [2.0 / (greatest - least) for least, greatest in ends]
        positions = [
            Observation(f"{joint}_position", "rad", scale, middle)
            for joint, scale, middle in zip(joints, scales, middles, strict=True)
        ]
        velocities = [Observation(f"{joint}_velocity", "rad/s", config.velocity_scale) for joint in joints]
        previous = [Observation(f"{joint}_previous_action", kind="previous_action") for joint in joints]
        angles = [min(max(angle, pair[0]), pair[1]) for angle, pair in zip(self._pose(), ends, strict=True)]
        actions = [
            motor(model, index, joint, "N m", angle)
            for index, joint, angle in zip(self._motors(), joints, angles, strict=True)
        ]
        return Interface((*torso, *positions, *velocities, *previous), tuple(actions))

    def _motors(self) -> list[int]:
        """The motor of each joint."""
        joint_of_motor = self.worlds.solver.mj_model.actuator_trnid[:, 0]
        return [int(np.flatnonzero(joint_of_motor == joint)[0]) for joint in range(1, 1 + self.action_size)]

    def _pose(self) -> list[float]:
        """Angle of each joint at the start, before noise [rad]."""
        return [self.start_pose.get(name, 0.0) for name in self.action_names]
