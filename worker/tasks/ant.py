"""A four-legged ant that runs along +x, with the observations and rewards known from Isaac Gym's Ant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import newton
import newton.examples
import warp as wp

from worker.simulation.episodes import (
    STEP,
    EpisodeArrays,
    add_reward,
    begin_episode,
    clear_row,
    end_step,
    is_finite,
    random_stream,
)
from worker.simulation.worlds import WorldArrays, root_rotation
from worker.tasks.config import PPOConfig, TaskConfig, reward_weights
from worker.tasks.task import Task

wp.set_module_options({"enable_backward": False})

JOINTS = wp.constant(8)
"""Hinges, in the order of the joint coordinates: hip and ankle of legs 1 to 4."""
FIRST_COORDINATE = wp.constant(7)
"""Joint coordinates of the torso's free joint: position, quaternion xyzw."""
FIRST_DOF = wp.constant(6)
"""Joint velocities of the torso's free joint: linear, angular."""


@dataclass(frozen=True)
class AntConfig(TaskConfig):
    """Run fast, straight and upright; do not drop the torso."""

    control_hz: float = 60.0
    """Control steps per simulated second [Hz]."""
    substeps: int = 2
    """Physics steps of one control step, each of 1/120 s."""
    episode_seconds: float = 16.0
    """Simulated time after which the clock ends an episode [s]."""
    fall_height: float = 0.31
    """Height of the torso under which the episode ends [m]."""
    start_height: float = 0.62
    """Height of the torso at the start [m]: the feet touch the ground within a few steps."""
    start_angle_noise: float = 0.2
    """A start moves each joint uniformly within +- this angle [rad], kept inside the joint's range."""
    start_velocity_noise: float = 0.1
    """A start gives each joint a uniform velocity within +- this [rad/s]."""
    velocity_scale: float = 0.2
    """Factor on joint velocities in observations and in the energy cost [s/rad]."""
    angular_velocity_scale: float = 0.25
    """Factor on the torso's angular velocity in observations [s/rad]."""
    rewards: Mapping[str, float] = reward_weights(
        forward=1.0, heading=0.5, up=0.1, alive=0.5, action=-0.005, energy=-0.05, limits=-0.1, fall=-2.0
    )
    """Weights of: the torso's velocity along +x [s/m]; facing +x (whole where the cosine is above 0.8, in proportion
    below); an upright torso (cosine to vertical above 0.93); each step that does not end in a fall; the sum of squared
    actions; the sum over joints of |action x scaled joint velocity|; each joint within 1 % of an end of its range; a fall,
    which replaces every other term of that step."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            steps=32,
            hidden_sizes=(400, 200, 100),
            activation="elu",
            epochs=5,
            minibatches=4,
            learning_rate=5.0e-4,
            desired_kl=0.01,
        )
    )
    """How the task is trained."""


@wp.struct
class AntParameters:
    """The fields of :class:`AntConfig` that the kernels use."""

    fall_height: float
    start_height: float
    start_angle_noise: float
    start_velocity_noise: float
    velocity_scale: float
    angular_velocity_scale: float


@wp.func
def joint_range(joint: int) -> wp.vec2:
    """Lower and upper end of a joint's range [rad], as in the model file."""
    lower = wp.radians(-40.0)
    upper = wp.radians(40.0)
    if joint == 1 or joint == 7:
        lower = wp.radians(30.0)
        upper = wp.radians(100.0)
    if joint == 3 or joint == 5:
        lower = wp.radians(-100.0)
        upper = wp.radians(-30.0)
    return wp.vec2(lower, upper)


@wp.func
def scaled_position(worlds: WorldArrays, world: int, joint: int) -> float:
    """Joint angle mapped so that its range becomes [-1, 1]."""
    ends = joint_range(joint)
    return (2.0 * worlds.joint_q[world, FIRST_COORDINATE + joint] - ends[0] - ends[1]) / (ends[1] - ends[0])


@wp.kernel
def act(parameters: AntParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """The action is each motor's share of its full torque, clipped to [-1, 1]."""
    world = wp.tid()
    for joint in range(JOINTS):
        # The model file lists the motors of leg 4 first.
        actuator = (joint + 2) % JOINTS
        worlds.controls[world, actuator] = wp.clamp(episodes.actions[world, joint], -1.0, 1.0)


@wp.func
def write_observation(
    observations: wp.array2d(dtype=wp.float32),
    parameters: AntParameters,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    world: int,
    first_step: bool,
):
    """Torso height, velocities in the torso frame, attitude, then joints, then the action that led here."""
    rotation = root_rotation(worlds, world)
    linear = wp.vec3(worlds.joint_qd[world, 0], worlds.joint_qd[world, 1], worlds.joint_qd[world, 2])
    angular = wp.vec3(worlds.joint_qd[world, 3], worlds.joint_qd[world, 4], worlds.joint_qd[world, 5])
    linear = wp.quat_rotate_inv(rotation, linear)
    angular = wp.quat_rotate_inv(rotation, angular) * parameters.angular_velocity_scale
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
    for joint in range(JOINTS):
        observations[world, 11 + joint] = scaled_position(worlds, world, joint)
        observations[world, 19 + joint] = worlds.joint_qd[world, FIRST_DOF + joint] * parameters.velocity_scale
        action = 0.0
        if not first_step:
            action = wp.clamp(episodes.actions[world, joint], -1.0, 1.0)
        observations[world, 27 + joint] = action


@wp.func
def place(parameters: AntParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Stand a world's ant at the origin facing +x, joints near their usual pose, with a cold solver."""
    stream = random_stream(episodes, world)
    clear_row(worlds.joint_q, world)
    clear_row(worlds.joint_qd, world)
    clear_row(worlds.warm_start, world)
    worlds.joint_q[world, 2] = parameters.start_height
    worlds.joint_q[world, 6] = 1.0
    for joint in range(JOINTS):
        ends = joint_range(joint)
        pose = 0.0
        if joint % 2 == 1:
            # Ankles bend by 1 rad, outwards: the pose that the model file gives as init_qpos.
            pose = wp.sign(ends[0])
        angle = pose + parameters.start_angle_noise * wp.randf(stream, -1.0, 1.0)
        worlds.joint_q[world, FIRST_COORDINATE + joint] = wp.clamp(angle, ends[0], ends[1])
        worlds.joint_qd[world, FIRST_DOF + joint] = parameters.start_velocity_noise * wp.randf(stream, -1.0, 1.0)


@wp.func
def add_rewards(parameters: AntParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Every reward term of a step without a fall."""
    rotation = root_rotation(worlds, world)
    heading = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))[0]
    upright = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))[2]
    effort = 0.0
    energy = 0.0
    limits = 0.0
    for joint in range(JOINTS):
        action = wp.clamp(episodes.actions[world, joint], -1.0, 1.0)
        velocity = worlds.joint_qd[world, FIRST_DOF + joint] * parameters.velocity_scale
        # of what the policy asked for: beyond the motors' limits nothing else would hold it back from drifting away
        effort += episodes.actions[world, joint] * episodes.actions[world, joint]
        energy += wp.abs(action * velocity)
        if wp.abs(scaled_position(worlds, world, joint)) > 0.99:
            limits += 1.0
    add_reward(episodes, world, 0, worlds.joint_qd[world, 0])
    add_reward(episodes, world, 1, wp.min(heading / 0.8, 1.0))
    if upright > 0.93:
        add_reward(episodes, world, 2, 1.0)
    add_reward(episodes, world, 3, 1.0)
    add_reward(episodes, world, 4, effort)
    add_reward(episodes, world, 5, energy)
    add_reward(episodes, world, 6, limits)


@wp.kernel
def observe(mode: int, max_age: int, parameters: AntParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """Reward, termination, statistics, masked reset and observation of one world a thread."""
    world = wp.tid()
    restart = mode != STEP
    if mode == STEP:
        valid = is_finite(worlds.joint_q, world) and is_finite(worlds.joint_qd, world)
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


def _names(kind: str) -> tuple[str, ...]:
    return tuple(f"{part}_{leg}_{kind}" for leg in range(1, 5) for part in ("hip", "ankle"))


class Ant(Task):
    """Newton's bundled ``nv_ant.xml``: 35 observations, 8 actions, 60 control steps a second, episodes of 16 s."""

    config_type = AntConfig
    parameters_type = AntParameters
    observation_names = (
        "torso_height",
        *(f"torso_velocity_{axis}" for axis in "xyz"),
        *(f"torso_angular_velocity_{axis}" for axis in "xyz"),
        "torso_yaw",
        "torso_roll",
        "torso_up",
        "torso_heading",
        *_names("position"),
        *_names("velocity"),
        *_names("previous_action"),
    )
    action_names = tuple(f"{part}_{leg}" for leg in range(1, 5) for part in ("hip", "ankle"))
    act: ClassVar[wp.Kernel] = act
    observe: ClassVar[wp.Kernel] = observe
    ground = True
    solver_options: ClassVar[dict[str, object]] = {
        # The worst case: 12 capsules with two contacts and one sphere with one, four rows each, and eight joint limits.
        "nconmax": 25,
        "njmax": 108,
        # Falls and heights are those of the file's 50 iterations at 1e-10, for a fraction of the time.
        "iterations": 3,
        "ls_iterations": 6,
        "tolerance": 1.0e-3,
    }

    def build(self, builder: newton.ModelBuilder) -> None:
        """The ant without the file's floor; its own parts do not collide with each other."""
        builder.add_mjcf(newton.examples.get_asset("nv_ant.xml"), ignore_names=["floor"], enable_self_collisions=False)
