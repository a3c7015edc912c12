"""The configurations of the cart-pole, with and without a camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

from pydantic.dataclasses import dataclass

from worker.settings.camera import CameraConfig
from worker.settings.overrides import from_mapping
from worker.settings.ppo import PPOConfig
from worker.settings.sac import SACConfig
from worker.settings.task import STRICT, Count, Positive, Rate, TaskConfig, reward_weights


@dataclass(frozen=True, config=STRICT)
class CartpoleConfig(TaskConfig):
    """The cart may not leave the rail and the pole may not fall past ``angle_limit``."""

    control_hz: Rate = 60.0
    """Control steps per simulated second [Hz]."""
    substeps: Count = 1
    """Physics steps of one control step: without contacts one step of 1/60 s is accurate enough."""
    episode_seconds: Positive = 5.0
    """Simulated time after which the clock ends an episode [s]."""
    cart_limit: float = 2.4
    """Distance of the cart from the middle of the rail at which the episode ends [m]."""
    angle_limit: float = 0.4
    """Tilt of the pole at which the episode ends [rad]."""
    start_position: float = 0.5
    """A start is uniform in +- this distance from the middle [m]."""
    start_angle: float = 0.15
    """A start is uniform in +- this tilt [rad]."""
    start_velocity: float = 0.3
    """A start is uniform in +- this velocity of the cart [m/s] and of the pole [rad/s]."""
    rewards: Mapping[str, float] = reward_weights(
        alive=0.1, angle=-0.1, position=-0.05, velocity=-0.05, effort=-0.001, fall=-2.0
    )
    """Weights of these terms:

    - ``alive``: each step that does not end in a fall;
    - ``angle``: squared tilt [1/rad^2];
    - ``position``: squared distance from the middle [1/m^2];
    - ``velocity``: squared velocity of the cart [s^2/m^2], since a cart that drifts meets the end of the rail too late to learn why;
    - ``effort``: squared action;
    - ``fall``: leaving the rail or dropping the pole, once."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            steps=16,
            hidden_sizes=(32, 32),
            epochs=4,
            minibatches=2,
            learning_rate_horizon=60,  # by then it balances; the few samples of an iteration allow no large steps afterwards
        )
    )
    """Settings of the task's training: a small network, since the task is easy and often runs on a CPU."""
    sac: SACConfig = field(
        default_factory=lambda: SACConfig(
            actor_sizes=(64, 64),
            critic_sizes=(64, 64),
            batch_size=256,
            updates=8,
            atoms=51,
            v_min=-5.0,
            v_max=5.0,
            actor_learning_rate=1.0e-3,
            critic_learning_rate=1.0e-3,
        )
    )
    """Settings of ``algorithm: sac``."""


@dataclass(frozen=True, config=STRICT)
class CartpolePixelsConfig(CartpoleConfig):
    """As :class:`CartpoleConfig`, on the part of the rail that the camera sees."""

    cart_limit: float = 1.4
    """Distance of the cart from the middle of the rail at which the episode ends [m]: there it leaves the image."""
    start_position: float = 0.3
    """A start is uniform in +- this distance from the middle [m]."""
    camera: Annotated[CameraConfig, from_mapping(CameraConfig)] = field(
        default_factory=lambda: CameraConfig(position=(0.0, -3.2, 1.4), target=(0.0, 0.0, 1.4), fov=0.93)
    )
    """The camera: it stands beside the rail and sees 3.2 m of it."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            steps=16,
            hidden_sizes=(64,),
            epochs=4,
            normalize_observations=False,
        )
    )
    """Settings of the task's training."""
