"""The pendulum of `my_task.py`, with kernels written by hand: what is possible where terms are not enough. The numbers are the same."""

from collections.abc import Mapping
from dataclasses import dataclass

import warp as wp

from worker.simulation.episodes import STEP, EpisodeArrays, add_reward, begin_episode, end_step, random_stream
from worker.simulation.worlds import WorldArrays, is_sound
from worker.tasks.config import TaskConfig, reward_weights
from worker.tasks.task import Task

MODEL = """<mujoco><worldbody><body pos="0 0 1">
  <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
</body></worldbody><actuator><motor joint="hinge" gear="2"/></actuator></mujoco>"""


@dataclass(frozen=True)
class PendulumConfig(TaskConfig):
    episode_seconds: float = 4.0
    torque: float = 1.0  # share of the motor's full torque that an action of 1 uses
    rewards: Mapping[str, float] = reward_weights(upright=1.0, speed=-0.01, effort=-0.01)  # in the order of the kernel


@wp.struct
class Parameters:
    torque: float  # filled from the configuration's field of the same name


@wp.kernel
def act(parameters: Parameters, worlds: WorldArrays, episodes: EpisodeArrays):
    world = wp.tid()
    worlds.controls[world, 0] = parameters.torque * wp.clamp(episodes.actions[world, 0], -1.0, 1.0)


@wp.kernel
def observe(mode: int, max_age: int, parameters: Parameters, worlds: WorldArrays, episodes: EpisodeArrays):
    world = wp.tid()
    restart = mode != STEP
    if mode == STEP:
        valid = is_sound(worlds, world)
        episodes.rewards[world] = 0.0
        add_reward(episodes, world, 0, -wp.cos(worlds.joint_q[world, 0]))
        add_reward(episodes, world, 1, worlds.joint_qd[world, 0] * worlds.joint_qd[world, 0])
        add_reward(episodes, world, 2, episodes.actions[world, 0] * episodes.actions[world, 0])
        restart = end_step(episodes, worlds.overflow, world, False, valid, max_age)
        if restart:
            write(episodes.terminal_observations, worlds, world)
    if restart:
        begin_episode(episodes, world)
        worlds.joint_q[world, 0] = wp.randf(random_stream(episodes, world), -wp.pi, wp.pi)
        worlds.joint_qd[world, 0] = 0.0
    write(episodes.observations, worlds, world)


@wp.func
def write(observations: wp.array2d(dtype=wp.float32), worlds: WorldArrays, world: int):
    observations[world, 0] = wp.cos(worlds.joint_q[world, 0])
    observations[world, 1] = wp.sin(worlds.joint_q[world, 0])
    observations[world, 2] = 0.1 * worlds.joint_qd[world, 0]


class PendulumByHand(Task):
    """A pendulum that hangs down and a motor that must swing it up: 3 observations, 1 action."""

    config_type, parameters_type, act, observe = PendulumConfig, Parameters, act, observe
    observation_names, action_names = ("cosine", "sine", "velocity"), ("hinge",)
    solver_options = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def build(self, builder):
        builder.add_mjcf(MODEL)
