"""Balance a pole on a cart that a motor pushes along a rail."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import newton
import warp as wp

import worker.tasks
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
from worker.simulation.worlds import WorldArrays, is_sound
from worker.tasks.configs.cartpole import CartpoleConfig
from worker.tasks.interface import Interface, Observation, motor
from worker.tasks.task import Task

wp.set_module_options({"enable_backward": False})


@wp.struct
class CartpoleParameters:
    """The fields of :class:`CartpoleConfig` that the kernels use."""

    cart_limit: float
    angle_limit: float
    start_position: float
    start_angle: float
    start_velocity: float


@wp.kernel
def act(parameters: CartpoleParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """The action is the motor's share of its full force, clipped to [-1, 1]."""
    world = wp.tid()
    worlds.controls[world, 0] = clipped_action(episodes, world, 0)


@wp.func
def write_observation(observations: wp.array2d[wp.float32], worlds: WorldArrays, world: int):
    """Cart position [m], pole angle [rad], their velocities [m/s, rad/s]."""
    observations[world, 0] = worlds.joint_q[world, 0]
    observations[world, 1] = worlds.joint_q[world, 1]
    observations[world, 2] = worlds.joint_qd[world, 0]
    observations[world, 3] = worlds.joint_qd[world, 1]


@wp.func
def place(parameters: CartpoleParameters, worlds: WorldArrays, episodes: EpisodeArrays, world: int):
    """Put a world at a random start."""
    stream = random_stream(episodes, world)
    worlds.joint_q[world, 0] = parameters.start_position * wp.randf(stream, -1.0, 1.0)
    worlds.joint_q[world, 1] = parameters.start_angle * wp.randf(stream, -1.0, 1.0)
    worlds.joint_qd[world, 0] = parameters.start_velocity * wp.randf(stream, -1.0, 1.0)
    worlds.joint_qd[world, 1] = parameters.start_velocity * wp.randf(stream, -1.0, 1.0)


@wp.kernel
def observe(mode: int, max_age: int, parameters: CartpoleParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """Reward, termination, statistics, masked reset and observation of one world a thread."""
    world = wp.tid()
    restart = mode != STEP
    if mode == STEP:
        valid = is_sound(worlds, world)
        position = worlds.joint_q[world, 0]
        angle = worlds.joint_q[world, 1]
        velocity = worlds.joint_qd[world, 0]
        effort = clipped_action(episodes, world, 0)
        fallen = valid and (wp.abs(position) > parameters.cart_limit or wp.abs(angle) > parameters.angle_limit)

        episodes.rewards[world] = 0.0
        if fallen:
            add_reward(episodes, world, 5, 1.0)
        else:
            add_reward(episodes, world, 0, 1.0)
        add_reward(episodes, world, 1, angle * angle)
        add_reward(episodes, world, 2, position * position)
        add_reward(episodes, world, 3, velocity * velocity)
        add_reward(episodes, world, 4, effort * effort)

        restart = end_step(episodes, worlds.overflow, world, fallen, valid, max_age)
        if restart:
            if valid:
                write_observation(episodes.terminal_observations, worlds, world)
            else:
                clear_row(episodes.terminal_observations, world)
    if restart:
        begin_episode(episodes, world)
        place(parameters, worlds, episodes, world)
    write_observation(episodes.observations, worlds, world)


class Cartpole(Task):
    """Cart and pole: 4 observations, 1 action, 60 control steps a second, episodes of 5 s."""

    config_type = CartpoleConfig
    parameters_type = CartpoleParameters
    observation_names = ("slider_position", "hinge_position", "slider_velocity", "hinge_velocity")
    action_names = ("slider",)
    act: ClassVar[wp.Kernel] = act
    observe: ClassVar[wp.Kernel] = observe
    solver_options: ClassVar[dict[str, object]] = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def build(self, builder: newton.ModelBuilder) -> None:
        """Cart on a slide joint, pole on a free hinge, motor on the slide; nothing collides."""
        builder.add_mjcf(str(Path(worker.tasks.__file__).with_name("cartpole.xml")))

    def interface(self) -> Interface:
        """Positions and velocities as they are; the force of the motor."""
        units = ("m", "rad", "m/s", "rad/s")
        observations = tuple(Observation(*pair) for pair in zip(self.observation_names, units, strict=True))
        return Interface(observations, (motor(self.worlds.solver.mj_model, 0, "slider", "N", 0.0),))
