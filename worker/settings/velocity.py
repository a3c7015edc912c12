"""The configurations of Go1 and G1 that follow velocity commands: mjlab 1.6's numbers (``tasks/velocity``)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Annotated, Any

from pydantic import Field, WrapValidator
from pydantic.dataclasses import dataclass

from shared_store.contract.error_text import shown
from worker.settings.overrides import Refused, expecting
from worker.settings.ppo import PPOConfig
from worker.settings.sac import SACConfig
from worker.settings.task import STRICT, Amount, Count, Finite, Positive, Range, Rate, TaskConfig, reward_weights

Share = Annotated[float, Field(ge=0, le=1)]


def _check_stages(stages: Any, inner: Any) -> Any:
    inner(stages)
    if stages[0][0] != 0 or any(not float(stage[0]).is_integer() for stage in stages):
        raise Refused((), f"its iterations are whole numbers, and the first is 0, found {shown(stages)}")
    if any(after[0] <= before[0] for before, after in itertools.pairwise(stages)):
        raise Refused((), f"the iterations of its stages must grow, found {shown(stages)}")
    if any(least > greatest for _, least, greatest in stages):
        raise Refused((), f"the least value comes before the greatest, found {shown(stages)}")
    return stages


Stages = Annotated[
    Sequence[Annotated[tuple[Finite, Finite, Finite], Field(strict=False)]],
    Field(min_length=1),
    expecting("stages [iteration, least, greatest]"),
    WrapValidator(_check_stages),
]


def range_at(stages: Sequence[Sequence[float]], iteration: int) -> tuple[float, float]:
    """Least and greatest value in an iteration, counted from 0: those of the last stage that has begun."""
    started = [stage for stage in stages if stage[0] <= iteration] or stages[:1]
    return started[-1][1], started[-1][2]


def widest(stages: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Least and greatest value of all stages."""
    return min(stage[1] for stage in stages), max(stage[2] for stage in stages)


PPO = PPOConfig(
    steps=24,
    hidden_sizes=(512, 256, 128),
    critic_observations="critic",
    learning_rate_horizon=500,  # it takes as long to walk
    entropy_coef=0.01,
    max_std=10.0,  # actions have no range in which more noise would cost nothing
)
"""That of mjlab's ``rl_cfg.py``, the same for both robots, with limits of rate and deviation that do not touch the time of learning."""
SAC = SACConfig(critic_group="critic", v_min=-10.0, v_max=10.0)  # the rewards of a step are at most 0.12


@dataclass(frozen=True, config=STRICT)
class VelocityConfig(TaskConfig):
    """Follow velocity commands with a natural gait, through pushes.

    Raises:
        ValueError: The stages of a command are malformed, or :class:`TaskConfig` refuses a value.

    ``rewards`` weighs these terms, each per second. Those of feet count only while more than 0.05 is commanded, speed [m/s] + turning
    velocity [rad/s]:

    - ``track_linear_velocity``: exp(-4 e^2), with the error e of the root's velocity, its vertical part included [m/s];
    - ``track_angular_velocity``: exp(-2 e^2), with the error e of its angular velocity, rolling and pitching included [rad/s];
    - ``upright``: exp(-5 s^2), with the sine s of the tilt;
    - ``pose``: exp(-mean e^2 / s^2) over the joints, with the distance e of each from its default and its tolerance s: the smallest
      while it is to stand, the largest from 1.5 commanded on;
    - ``body_ang_vel``: squared rolling and pitching velocities of the trunk, or torso [s^2/rad^2];
    - ``angular_momentum``: squared angular momentum of the whole robot [s^2/(kg^2 m^4)];
    - ``dof_pos_limits``: sum of distances into the last twentieth at the ends of the joints' ranges [1/rad];
    - ``action_rate_l2``: sum of squared changes of the action;
    - ``air_time``: feet that have been in the air for 0.05 to 0.5 s, while more than 0.5 is commanded;
    - ``foot_clearance``: sum of a foot's distance from 10 cm above the ground x its horizontal speed [s/m^2];
    - ``foot_swing_height``: at touchdown, squared difference of a swing's greatest height from 10 cm, in units of 10 cm;
    - ``foot_slip``: sum of squared horizontal speeds of feet on the ground [s^2/m^2];
    - ``soft_landing``: force of a touchdown [1/N];
    - ``self_collisions``, ``shank_collision``, ``trunk_head_collision``: physics steps in which the robot touches itself, or a shank,
      the trunk or the head the ground, with more than 10 N.
    """

    control_hz: Rate = 50.0
    """Control steps per simulated second [Hz]."""
    substeps: Count = 4
    """Physics steps of one control step, each of 1/200 s."""
    episode_seconds: Positive = 20.0
    """Simulated time after which the clock ends an episode [s]."""
    command_forward: Stages = ((0, -1.0, 1.0), (5000, -1.5, 2.0), (10000, -2.0, 3.0))
    """Commanded velocities forward [m/s], uniform: stages ``[iteration, least, greatest]``, each valid from its iteration on; an
    iteration of mjlab's has 24 steps."""
    command_left: Stages = ((0, -1.0, 1.0),)
    """Commanded velocities to the left [m/s], as ``command_forward``."""
    command_turn: Stages = ((0, -0.5, 0.5), (5000, -0.7, 0.7))
    """Commanded turning velocities to the left [rad/s], as ``command_forward``."""
    command_seconds: Range = (3.0, 8.0)
    """Duration of a command, in simulated time [s], uniform; an episode begins with a new one."""
    command_stand: Share = 0.1
    """Share of commands to stand still."""
    command_heading: Share = 0.3
    """Share of commands to turn to a heading, uniform in all directions."""
    command_ahead: Share = 0.2
    """Share of commands to go straight ahead, at 0.3 m/s or more."""
    heading_stiffness: Amount = 0.5
    """Turning velocity of a heading command per rad of heading error [1/s]."""
    push_seconds: Range = (1.0, 3.0)
    """Simulated time between two pushes of a world [s], uniform."""
    solver_iterations: Count = 10
    """Limit of the solver's iterations; fewer are faster, with less exact contacts."""
    solver_line_search: Count = 20
    """Limit of the iterations of its line search."""
    ppo: PPOConfig = field(default_factory=lambda: PPO)
    """Settings of the task's training."""
    sac: SACConfig = field(default_factory=lambda: SAC)
    """Settings of ``algorithm: sac``."""


_WALK: Mapping[str, float] = {
    "track_linear_velocity": 2.0,
    "track_angular_velocity": 2.0,
    "upright": 1.0,
    "pose": 1.0,
    "body_ang_vel": 0.0,
    "angular_momentum": 0.0,
    "dof_pos_limits": -1.0,
    "action_rate_l2": -0.1,
    "air_time": 0.0,
    "foot_clearance": -2.0,
    "foot_swing_height": -0.25,
    "foot_slip": -0.1,
    "soft_landing": -1.0e-5,
}
_G1 = {**_WALK, "body_ang_vel": -0.05, "angular_momentum": -0.02, "self_collisions": -1.0}


@dataclass(frozen=True, config=STRICT)
class Go1FlatConfig(VelocityConfig):
    """A four-legged robot on a plane. Rewards: see :class:`VelocityConfig`."""

    rewards: Mapping[str, float] = reward_weights(**_WALK)


@dataclass(frozen=True, config=STRICT)
class Go1RoughConfig(VelocityConfig):
    """A four-legged robot on stairs, slopes and rough ground. Rewards: see :class:`VelocityConfig`."""

    rewards: Mapping[str, float] = reward_weights(
        **_WALK, self_collisions=-0.1, shank_collision=-0.1, trunk_head_collision=-0.1
    )


@dataclass(frozen=True, config=STRICT)
class G1FlatConfig(VelocityConfig):
    """A humanoid on a plane. Rewards: see :class:`VelocityConfig`."""

    rewards: Mapping[str, float] = reward_weights(**_G1)


@dataclass(frozen=True, config=STRICT)
class G1RoughConfig(VelocityConfig):
    """A humanoid on stairs, slopes and rough ground. Rewards: see :class:`VelocityConfig`."""

    rewards: Mapping[str, float] = reward_weights(**_G1)
