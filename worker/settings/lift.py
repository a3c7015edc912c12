"""The configuration of the arm that lifts a cube."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import field
from types import MappingProxyType
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from worker.settings.ppo import PPOConfig
from worker.settings.task import STRICT, Count, Points, Positive, Range, Rate, TaskConfig, reward_weights
from worker.settings.velocity import PPO

CALM = ((0, -0.01), (499, -0.01), (500, -0.1), (999, -0.1), (1000, -1.0))
"""Weight of ``joint_vel_hinge`` by iteration: mjlab's stages at 12,000 and 24,000 control steps, of iterations of 24."""


@dataclass(frozen=True, config=STRICT)
class LiftCubeConfig(TaskConfig):
    """Grip a cube, bring it to the target and hold it there. All numbers are those of mjlab 1.6's ``Mjlab-Lift-Cube-Yam``.

    Raises:
        ValueError: A range is malformed, or :class:`TaskConfig` refuses a value.
    """

    control_hz: Rate = 50.0
    """Control steps per simulated second [Hz]."""
    substeps: Count = 4
    """Physics steps of one control step, each of 1/200 s."""
    episode_seconds: Positive = 20.0
    """Simulated time after which the clock ends an episode [s]."""
    command_seconds: Range = (8.0, 12.0)
    """Duration of a target [s]; with the next one, the cube is moved, too."""
    target_x: Range = (0.3, 0.5)
    """Targets along the world's x, in front of the arm [m], uniform."""
    target_y: Range = (-0.2, 0.2)
    """Targets along y, to the arm's left [m], uniform."""
    target_z: Range = (0.2, 0.4)
    """Heights of targets [m], uniform."""
    cube_x: Range = (0.2, 0.4)
    """Positions of the cube along x [m], uniform."""
    cube_y: Range = (-0.2, 0.2)
    """Range of the cube's first place along y [m], uniform."""
    cube_z: Range = (0.02, 0.05)
    """Height from which the cube drops [m], uniform; it lies at 0.02."""
    cube_yaw: Range = (-3.14, 3.14)
    """Yaw of the cube [rad], uniform."""
    ground_force: Positive = 10.0
    """Force of a contact of the gripper with the ground above which the episode ends [N]."""
    rewards: Mapping[str, float] = reward_weights(
        lift=1.0, lift_precise=1.0, action_rate_l2=-0.01, joint_pos_limits=-10.0, joint_vel_hinge=-0.01
    )
    """Weights of these terms, each per second:

    - ``lift``: r (1 + b), r = exp(-d^2 / 0.2^2) of the distance d between gripper and cube, b = exp(-e^2 / 0.3^2) of the distance e
      between cube and target [m];
    - ``lift_precise``: exp(-e^2 / 0.05^2);
    - ``action_rate_l2``: sum of squared changes of the action;
    - ``joint_pos_limits``: sum of how far joints are outside the middle nine tenths of their ranges [rad, m];
    - ``joint_vel_hinge``: sum of the squares of how much faster than 0.5 joints are [rad/s, m/s]; ``curriculum`` raises it."""
    curriculum: Mapping[str, Points] = field(default_factory=lambda: MappingProxyType({"joint_vel_hinge": CALM}))
    """As that of every task; by default ``joint_vel_hinge`` weighs -0.01, from iteration 500 on -0.1, from 1000 on -1."""
    ppo: PPOConfig = field(default_factory=lambda: dataclasses.replace(PPO, entropy_coef=0.005))
    """Settings of the task's training."""


@dataclass(frozen=True, config=STRICT)
class LiftCubesConfig(LiftCubeConfig):
    """Grip the chosen one of several cubes, as :class:`LiftCubeConfig`; the rewards refer to the chosen cube.

    Ranges are those of mjlab 1.6's ``Mjlab-Multi-Cube-Seg-Yam``.
    """

    cubes: Annotated[int, Field(ge=1, le=6)] = 3
    """Number of cubes, 1 to 6."""
    cube_x: Range = (0.25, 0.4)
    """Range of each cube's first place along x [m], uniform."""
    cube_y: Range = (-0.15, 0.15)
    """Range of each cube's first place along y [m], uniform."""
