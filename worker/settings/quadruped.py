"""The configuration of the quadruped, the four-legged robot that follows velocity commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from worker.settings.ppo import PPOConfig
from worker.settings.task import STRICT, Count, Positive, Range, Rate, TaskConfig, reward_weights


@dataclass(frozen=True, config=STRICT)
class QuadrupedConfig(TaskConfig):
    """Follow velocity commands, level and smoothly; do not touch the ground with the trunk.

    Raises:
        ValueError: A range of commands is malformed, or :class:`TaskConfig` refuses a value.
    """

    control_hz: Rate = 50.0
    """Control steps per simulated second [Hz]."""
    substeps: Count = 4
    """Physics steps of one control step, each of 1/200 s."""
    episode_seconds: Positive = 20.0
    """Simulated time after which the clock ends an episode [s]."""
    fastest: Positive = 100.0
    """Joint velocity at which the physics counts as failed [m/s, rad/s]; a healthy robot stays below 40."""
    action_scale: float = 0.5
    """Offset of a joint's target from its standing angle for an action of 1 [rad]."""
    stand_hip: float = 0.0
    """Standing angle of the hips [rad]."""
    stand_thigh: float = 0.8
    """Standing angle of the thighs [rad]."""
    stand_knee: float = -1.6
    """Standing angle of the knees [rad]: the feet are below the hips."""
    start_height: float = 0.32
    """Height of the trunk's middle at the start [m]: the feet are 5 mm above the ground."""
    start_angle_noise: float = 0.1
    """A start moves each joint uniformly within +- this angle [rad]."""
    start_velocity_noise: float = 0.1
    """A start gives the trunk and each joint a uniform velocity within +- this [m/s, rad/s]."""
    tilt_limit: float = 1.0
    """Angle between the trunk's upward axis and the vertical at which the episode ends [rad]."""
    command_forward: Range = (-1.0, 1.0)
    """Commanded velocities along the trunk's +x [m/s], uniform."""
    command_left: Range = (-0.5, 0.5)
    """Commanded velocities along the trunk's +y [m/s], uniform."""
    command_turn: Range = (-1.0, 1.0)
    """Commanded turning velocities about the trunk's +z [rad/s], uniform."""
    command_stand: Annotated[float, Field(ge=0, le=1)] = 0.1
    """Share of commands to stand still."""
    command_seconds: Positive = 5.0
    """Duration of a command, in simulated time [s]; an episode begins with a new one."""
    velocity_scale: float = 0.05
    """Factor on joint velocities in observations [s/rad]."""
    rewards: Mapping[str, float] = reward_weights(
        track_linear=2.0,
        track_angular=1.0,
        lin_vel_z=-2.0,
        ang_vel_xy=-0.05,
        orientation=-2.5,
        torques=-1.0e-4,
        action_rate=-0.01,
        pose=-0.05,
        limits=-5.0,
        fall=-2.0,
    )
    """Weights of these terms, each per second but the last:

    - ``track_linear``: exp(-4 e^2), with the error e of the horizontal velocity [m/s];
    - ``track_angular``: exp(-4 e^2), with the error e of the turning velocity [rad/s];
    - ``lin_vel_z``: squared vertical velocity [s^2/m^2];
    - ``ang_vel_xy``: squared rolling and pitching velocities [s^2/rad^2];
    - ``orientation``: squared horizontal part of the vertical in the trunk's frame;
    - ``torques``: sum of squared torques [1/(N m)^2];
    - ``action_rate``: sum of squared changes of the action;
    - ``pose``: sum of squared distances to the standing angles [1/rad^2];
    - ``limits``: sum of distances into the last twentieth at the ends of the joints' ranges [1/rad];
    - ``fall``: fall penalty, once; large enough that early falling never pays."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            steps=24,
            hidden_sizes=(128, 128, 128),
            entropy_coef=0.005,
            init_std=0.6,
        )
    )
    """Settings of the task's training."""
