"""The configurations of the running robots, which run along +x."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import field

from pydantic.dataclasses import dataclass

from worker.settings.ppo import PPOConfig
from worker.settings.sac import SACConfig
from worker.settings.task import STRICT, Count, Positive, Rate, TaskConfig, reward_weights

SAC = SACConfig(
    batch_size=4096,
    v_min=-20.0,
    v_max=1500.0,  # the fastest ants earn 38 a step: discounted, 1260; with 700 four fifths of the targets were beyond it
    actor_learning_rate=1.0e-3,
    critic_learning_rate=1.0e-3,
)


@dataclass(frozen=True, config=STRICT)
class RunningConfig(TaskConfig):
    """Run fast, straight and upright; do not fall.

    ``rewards`` weighs these terms:

    - ``forward``: velocity of the torso along +x [s/m];
    - ``heading``: 1 where the cosine to +x is above 0.8, in proportion below;
    - ``up``: 1 where the cosine of the torso to the vertical is above 0.93;
    - ``alive``: 1 in each step that does not end in a fall;
    - ``action``: sum of squared actions;
    - ``energy``: sum over joints of |action x scaled joint velocity| x strength;
    - ``limits``: sum over joints of how far each is into the last hundredth at an end of its range (0 to 1) x strength;
    - ``fall``: 1 in the step of a fall, in which every other term is 0.

    The strength of a joint is the full torque of its motor over that of the strongest motor.
    """

    control_hz: Rate = 60.0
    """Control steps per simulated second [Hz]."""
    substeps: Count = 2
    """Physics steps of one control step, each of 1/120 s."""
    episode_seconds: Positive = 16.0
    """Simulated time after which the clock ends an episode [s]."""
    fastest: Positive = 100.0
    """Joint velocity at which the physics counts as failed [m/s, rad/s]; a healthy robot stays below 70."""
    fall_height: float = 0.0
    """Height of the torso under which the episode ends [m]."""
    start_height: float = 1.0
    """Height of the torso at the start [m]."""
    start_angle_noise: float = 0.2
    """A start moves each joint uniformly within +- this angle [rad], kept inside the joint's range."""
    start_velocity_noise: float = 0.1
    """A start gives each joint a uniform velocity within +- this [rad/s]."""
    velocity_scale: float = 0.1
    """Factor on joint velocities in observations and in the energy cost [s/rad]."""
    angular_velocity_scale: float = 0.25
    """Factor on the torso's angular velocity in observations [s/rad]."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            hidden_sizes=(400, 200, 100),
            learning_rate=5.0e-4,
        )
    )
    """Settings of the task's training."""
    sac: SACConfig = field(default_factory=lambda: SAC)
    """Settings of ``algorithm: sac``."""


@dataclass(frozen=True, config=STRICT)
class AntConfig(RunningConfig):
    """Run fast, straight and upright; do not drop the torso. Rewards: see :class:`RunningConfig`."""

    fall_height: float = 0.31
    """Height of the torso under which the episode ends [m]."""
    start_height: float = 0.62
    """Height of the torso at the start [m]: the feet touch the ground within a few steps."""
    velocity_scale: float = 0.2
    """Factor on joint velocities in observations and in the energy cost [s/rad]."""
    rewards: Mapping[str, float] = reward_weights(
        forward=1.0, heading=0.5, up=0.1, alive=0.5, action=-0.005, energy=-0.05, limits=-0.1, fall=-2.0
    )


@dataclass(frozen=True, config=STRICT)
class HumanoidConfig(RunningConfig):
    """Run fast, straight and upright; do not fall. Rewards: see :class:`RunningConfig`."""

    fall_height: float = 0.8
    """Height of the torso under which the episode ends [m]."""
    start_height: float = 1.34
    """Height of the torso at the start [m]: the feet are 5 cm above the ground."""
    sac: SACConfig = field(default_factory=lambda: dataclasses.replace(SAC, gamma=0.99, v_max=1400.0))
    """Settings of ``algorithm: sac``: a longer horizon than the ant's."""
    rewards: Mapping[str, float] = reward_weights(
        forward=1.0, heading=0.5, up=0.1, alive=2.0, action=-0.01, energy=-0.05, limits=-0.25, fall=-1.0
    )
