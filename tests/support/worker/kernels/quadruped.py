"""A four-legged robot that follows velocity commands on flat ground: forward, sideways and turning."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import newton
import numpy as np
import warp as wp

import worker.tasks
from worker.simulation.episodes import (
    ACTION_LIMIT,
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
from worker.tasks.configs.quadruped import QuadrupedConfig
from worker.tasks.interface import Interface, Observation, servo
from worker.tasks.task import Task

wp.set_module_options({"enable_backward": False})

JOINTS = wp.constant(12)
"""Hinges, in the order of the joint coordinates and of the drives: hip, thigh and knee of each leg."""
COMMAND = wp.constant(0)
"""First of three columns of ``memory``: the commanded velocities forward and to the left [m/s], turning left [rad/s]."""
COUNTDOWN = wp.constant(3)
"""Column of ``memory``: control steps until the next command."""
LAST_ACTION = wp.constant(4)
"""First of twelve columns of ``memory``: the action of the last step, as it was asked for."""

JOINT_NAMES = tuple(
    f"{leg}_{part}"
    for leg in ("front_left", "front_right", "rear_left", "rear_right")
    for part in ("hip", "thigh", "knee")
)


@wp.struct
class QuadrupedParameters:
    """The fields of :class:`QuadrupedConfig` that the kernels use, and what the model says."""

    control_hz: float
    action_scale: float
    stand_hip: float
    stand_thigh: float
    stand_knee: float
    start_height: float
    start_angle_noise: float
    start_velocity_noise: float
    tilt_limit: float
    command_forward: wp.vec2
    command_left: wp.vec2
    command_turn: wp.vec2
    command_stand: float
    command_seconds: float
    velocity_scale: float
    ranges: wp.array[wp.vec2]
    """Lower and upper end of each joint's range [rad], shape ``(joints,)``."""
    trunk: wp.vec3
    """Half the trunk's length, width and height [m]."""


@wp.func
def standing_angle(parameters: QuadrupedParameters, joint: int) -> float:
    """Angle of a joint when the robot stands [rad]."""
    if joint % 3 == 0:
        return parameters.stand_hip
    if joint % 3 == 1:
        return parameters.stand_thigh
    return parameters.stand_knee


@wp.func
def new_command(parameters: QuadrupedParameters, episodes: EpisodeArrays, world: int, stream: wp.uint32):
    """Draw a command and start its clock."""
    forward = wp.randf(stream, parameters.command_forward[0], parameters.command_forward[1])
    left = wp.randf(stream, parameters.command_left[0], parameters.command_left[1])
    turn = wp.randf(stream, parameters.command_turn[0], parameters.command_turn[1])
    share = episodes.level[0]
    if wp.randf(stream) < parameters.command_stand:
        share = 0.0
    episodes.memory[world, COMMAND] = share * forward
    episodes.memory[world, COMMAND + 1] = share * left
    episodes.memory[world, COMMAND + 2] = share * turn
    episodes.memory[world, COUNTDOWN] = wp.max(1.0, wp.round(parameters.command_seconds * parameters.control_hz))


@wp.kernel
def act(parameters: QuadrupedParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """The action, clipped to [-1, 1], moves each joint's target from its standing angle."""
    world = wp.tid()
    for joint in range(JOINTS):
        action = clipped_action(episodes, world, joint)
        worlds.controls[world, joint] = standing_angle(parameters, joint) + parameters.action_scale * action


@wp.func
def write_observation(
    observations: wp.array2d[wp.float32],
    parameters: QuadrupedParameters,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    world: int,
):
    """Velocities and the direction of gravity in the trunk's frame, the command, joints, the action that led here."""
    rotation = root_rotation(worlds, world)
    linear, angular = root_velocities(worlds, world)
    gravity = wp.quat_rotate_inv(rotation, wp.vec3(0.0, 0.0, -1.0))
    for axis in range(3):
        observations[world, axis] = linear[axis]
        observations[world, 3 + axis] = angular[axis]
        observations[world, 6 + axis] = gravity[axis]
        observations[world, 9 + axis] = episodes.memory[world, COMMAND + axis]
    for joint in range(JOINTS):
        angle = worlds.joint_q[world, FIRST_COORDINATE + joint]
        observations[world, 12 + joint] = angle - standing_angle(parameters, joint)
        observations[world, 24 + joint] = worlds.joint_qd[world, FIRST_DOF + joint] * parameters.velocity_scale
        action = episodes.memory[world, LAST_ACTION + joint]
        observations[world, 36 + joint] = wp.clamp(action, -ACTION_LIMIT, ACTION_LIMIT)


@wp.func
def place(parameters: QuadrupedParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Stand a world's robot at the origin facing +x, with a new command."""
    stream = random_stream(episodes, world)
    clear_row(worlds.joint_q, world)
    worlds.joint_q[world, 2] = parameters.start_height
    worlds.joint_q[world, 6] = 1.0
    for dof in range(FIRST_DOF + JOINTS):
        worlds.joint_qd[world, dof] = parameters.start_velocity_noise * wp.randf(stream, -1.0, 1.0)
    for joint in range(JOINTS):
        angle = standing_angle(parameters, joint) + parameters.start_angle_noise * wp.randf(stream, -1.0, 1.0)
        worlds.joint_q[world, FIRST_COORDINATE + joint] = angle
    new_command(parameters, episodes, world, stream)


@wp.func
def has_fallen(parameters: QuadrupedParameters, worlds: WorldArrays, world: int) -> bool:
    """Whether the trunk touches the ground, with its lowest corner, or is tilted too far."""
    up = wp.quat_rotate_inv(root_rotation(worlds, world), wp.vec3(0.0, 0.0, 1.0))
    below = (
        wp.abs(up[0]) * parameters.trunk[0] + wp.abs(up[1]) * parameters.trunk[1] + wp.abs(up[2]) * parameters.trunk[2]
    )
    return worlds.joint_q[world, 2] < below or up[2] < wp.cos(parameters.tilt_limit)


@wp.func
def add_rewards(parameters: QuadrupedParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Every reward term of a step, times the length of the step [s]."""
    rotation = root_rotation(worlds, world)
    linear, angular = root_velocities(worlds, world)
    gravity = wp.quat_rotate_inv(rotation, wp.vec3(0.0, 0.0, -1.0))
    forward = linear[0] - episodes.memory[world, COMMAND]
    left = linear[1] - episodes.memory[world, COMMAND + 1]
    turn = angular[2] - episodes.memory[world, COMMAND + 2]
    torques = 0.0
    change = 0.0
    pose = 0.0
    limits = 0.0
    for joint in range(JOINTS):
        torque = worlds.drives[world, FIRST_DOF + joint]
        # of what the policy asked for: beyond the limits nothing else would hold it back from drifting away
        difference = episodes.actions[world, joint] - episodes.memory[world, LAST_ACTION + joint]
        angle = worlds.joint_q[world, FIRST_COORDINATE + joint]
        ends = parameters.ranges[joint]
        margin = 0.05 * (ends[1] - ends[0])
        torques += torque * torque
        change += difference * difference
        pose += (angle - standing_angle(parameters, joint)) * (angle - standing_angle(parameters, joint))
        limits += wp.max(ends[0] + margin - angle, 0.0) + wp.max(angle - ends[1] + margin, 0.0)
    seconds = 1.0 / parameters.control_hz
    add_reward(episodes, world, 0, seconds * wp.exp(-4.0 * (forward * forward + left * left)))
    add_reward(episodes, world, 1, seconds * wp.exp(-4.0 * turn * turn))
    add_reward(episodes, world, 2, seconds * linear[2] * linear[2])
    add_reward(episodes, world, 3, seconds * (angular[0] * angular[0] + angular[1] * angular[1]))
    add_reward(episodes, world, 4, seconds * (gravity[0] * gravity[0] + gravity[1] * gravity[1]))
    add_reward(episodes, world, 5, seconds * torques)
    add_reward(episodes, world, 6, seconds * change)
    add_reward(episodes, world, 7, seconds * pose)
    add_reward(episodes, world, 8, seconds * limits)


@wp.kernel
def observe(mode: int, max_age: int, parameters: QuadrupedParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """Reward, termination, statistics, masked reset, commands and observation of one world a thread."""
    world = wp.tid()
    restart = mode != STEP
    if mode == STEP:
        valid = is_sound(worlds, world)
        fallen = valid and has_fallen(parameters, worlds, world)
        episodes.rewards[world] = 0.0
        if valid:
            add_rewards(parameters, worlds, episodes, world)
        if fallen:
            add_reward(episodes, world, 9, 1.0)
        for joint in range(JOINTS):
            episodes.memory[world, LAST_ACTION + joint] = episodes.actions[world, joint]
        restart = end_step(episodes, worlds.overflow, world, fallen, valid, max_age)
        if restart:
            if valid:
                write_observation(episodes.terminal_observations, parameters, worlds, episodes, world)
            else:
                clear_row(episodes.terminal_observations, world)
        else:
            episodes.memory[world, COUNTDOWN] = episodes.memory[world, COUNTDOWN] - 1.0
            if episodes.memory[world, COUNTDOWN] < 0.5:
                new_command(parameters, episodes, world, random_stream(episodes, world))
    if restart:
        begin_episode(episodes, world)
        place(parameters, worlds, episodes, world)
    write_observation(episodes.observations, parameters, worlds, episodes, world)


class Quadruped(Task):
    """``quadruped.xml`` beside this file: 48 observations, 12 actions, 50 control steps a second, episodes of 20 s."""

    config_type = QuadrupedConfig
    parameters_type = QuadrupedParameters
    observation_names = (
        *(f"trunk_velocity_{axis}" for axis in "xyz"),
        *(f"trunk_angular_velocity_{axis}" for axis in "xyz"),
        *(f"gravity_{axis}" for axis in "xyz"),
        "command_forward",
        "command_left",
        "command_turn",
        *(f"{joint}_{kind}" for kind in ("position", "velocity", "previous_action") for joint in JOINT_NAMES),
    )
    action_names = JOINT_NAMES
    act: ClassVar[wp.Kernel] = act
    observe: ClassVar[wp.Kernel] = observe
    ground = True
    memory_size = 16
    solver_options: ClassVar[dict[str, object]] = {
        # The worst case: eight corners and eight spheres with a contact of four rows each, and twelve joint limits. In 96
        # worlds x 300 steps of random, zero and held random actions there were at most 16 contacts and 26 rows.
        "nconmax": 16,
        "njmax": 76,
        "iterations": 4,
        "ls_iterations": 8,
        "tolerance": 1.0e-4,
    }

    def build(self, builder: newton.ModelBuilder) -> None:
        """The robot as it stands; its own parts do not collide with each other."""
        # Drives take their targets from the controls, as motors do in other tasks.
        builder.add_mjcf(
            str(Path(worker.tasks.__file__).with_name("quadruped.xml")), enable_self_collisions=False, ctrl_direct=True
        )
        config: Any = self.config
        builder.joint_q[2] = config.start_height
        builder.joint_q[7:] = [config.stand_hip, config.stand_thigh, config.stand_knee] * 4

    def read_model(self, parameters: Any) -> None:
        """Ranges of the joints and size of the trunk."""
        model = self.worlds.solver.mj_model
        assert np.array_equal(model.actuator_trnid[:, 0], range(1, 1 + len(JOINT_NAMES))), (
            "drives are in the joints' order"
        )
        [trunk] = np.flatnonzero(model.geom_type == 6)
        parameters.ranges = wp.array(model.jnt_range[1:], dtype=wp.vec2, device=self.device)
        parameters.trunk = wp.vec3(*model.geom_size[trunk])

    def interface(self) -> Interface:
        """Angles from the standing pose; targets of the drives."""
        config: Any = self.config
        standing = [config.stand_hip, config.stand_thigh, config.stand_knee] * 4
        trunk = [Observation(f"trunk_velocity_{axis}", "m/s") for axis in "xyz"]
        trunk += [Observation(f"trunk_angular_velocity_{axis}", "rad/s") for axis in "xyz"]
        trunk += [Observation(f"gravity_{axis}") for axis in "xyz"]
        commands = [
            Observation(f"command_{name}", unit, kind="command", range=getattr(config, f"command_{name}"))
            for name, unit in (("forward", "m/s"), ("left", "m/s"), ("turn", "rad/s"))
        ]
        positions = [
            Observation(f"{joint}_position", "rad", offset=angle)
            for joint, angle in zip(JOINT_NAMES, standing, strict=True)
        ]
        velocities = [Observation(f"{joint}_velocity", "rad/s", config.velocity_scale) for joint in JOINT_NAMES]
        previous = [Observation(f"{joint}_previous_action", kind="previous_action") for joint in JOINT_NAMES]
        model = self.worlds.solver.mj_model
        actions = [
            servo(model, index, joint, "rad", angle, config.action_scale)
            for index, (joint, angle) in enumerate(zip(JOINT_NAMES, standing, strict=True))
        ]
        return Interface((*trunk, *commands, *positions, *velocities, *previous), tuple(actions))
