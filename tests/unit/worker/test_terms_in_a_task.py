"""A declared task that is made of terms of every kind: it compiles, steps, and shows what its terms say."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from pydantic.dataclasses import dataclass

from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.frames import Frames
from worker.simulation.sensors.imu import Imu
from worker.simulation.sensors.momentum import AngularMomentum
from worker.tasks import terms
from worker.tasks.config import STRICT, reward_weights
from worker.tasks.declaration import Action, Command, Declaration, Event, Metric, Observation, Reward, Term, Termination
from worker.tasks.quadruped import Quadruped, QuadrupedConfig
from worker.tasks.randomize import Randomize


@dataclass(frozen=True, config=STRICT)
class WalkerConfig(QuadrupedConfig):
    """The weights of the rewards below."""

    rewards: Mapping[str, float] = reward_weights(
        track=1.0, turn=0.5, posture=1.0, slip=-0.1, swing=-0.1, rate=-0.01, limits=-1.0
    )


class Walker(Quadruped):
    """The quadruped with terms as of mjlab's velocity tasks."""

    config_type = WalkerConfig

    def declare(self, config: QuadrupedConfig) -> Declaration:
        turn = (-1.0, 1.0)
        return Declaration(
            actions={"target": Action(terms.position_target, scale=0.5, offset="default", kind="position", unit="rad")},
            observations={
                "velocity": Observation(terms.root_linear_velocity),
                "gravity": Observation(terms.projected_gravity),
                "gyro": Observation(terms.imu_angular_velocity),
                "command": Observation(terms.command_number, size=3),
                "offset": Observation(terms.measured_joint_offset),
                "action": Observation(terms.last_action),
                "touch": Observation(terms.in_contact, size=4),
                "clock": Observation(terms.gait_clock, period=0.5),
                "shank": Observation(terms.body_position_in_root, bodies="*_shank"),
                "element": Observation(terms.root_orientation_element, size=6),
            },
            rewards={
                "track": Reward(terms.track_linear_velocity, per_second=True, std=0.5),
                "turn": Reward(terms.track_angular_velocity, std=0.5),
                "posture": Reward(terms.commanded_posture),
                "slip": Reward(terms.foot_slip, size=4),
                "swing": Reward(terms.swing_height_error, size=4, memory=4, height=0.1),
                "rate": Reward(terms.action_rate_squared),
                "limits": Reward(terms.joint_limit_excess, joints="*_knee", soft_factor=0.9),
            },
            metrics={
                "speed_error": Metric(terms.planar_velocity_error),
                "momentum": Metric(terms.angular_momentum_squared),
                "air": Metric(terms.commanded_time_in_air, size=4),
                "hard": Metric(terms.hard_contact_steps, force=50.0),
                "work": Metric(terms.joint_work),
            },
            terminations={
                "tilted": Termination(terms.root_tilted, limit=1.2),
                "low": Termination(terms.body_too_low, bodies="trunk", height=0.05),
                "hit": Termination(terms.illegal_contact, size=4, force=1e5),
            },
            commands={
                "velocity": Command(
                    terms.heading_velocity_command,
                    names=("forward", "left", "turn"),
                    hidden=6,
                    seconds=(0.1, 0.2),
                    update=Term(terms.steer_velocity_command, command="velocity", turn=turn, stiffness=0.5),
                    forward=(-1.0, 1.0),
                    left=(-0.5, 0.5),
                    turn=turn,
                    heading=(-3.14, 3.14),
                )
            },
            events={
                "root": Event(terms.reset_root, x=(-0.5, 0.5), y=(-0.5, 0.5), yaw=(-3.14, 3.14)),
                "joints": Event(terms.reset_joints_by_offset, position=(-0.1, 0.1)),
                "push": Event(terms.push, when="interval", seconds=(0.1, 0.2), velocity_x=(-0.2, 0.2)),
            },
            randomize={"bias": Randomize("encoder_bias", joints="*", range=(-0.02, 0.02), operation="add")},
            sensors={
                "feet": ContactSensor(geoms="*_foot", against="ground", fine=True),
                "shanks": Frames(bodies="*_shank"),
                "imu": Imu(body="trunk"),
                "momentum": AngularMomentum(),
                "tolerances": terms.Tolerances(standing={"*_knee": 0.2, "*": 0.1}, walking=0.4),
            },
        )


def test_a_task_of_terms_steps_and_shows_its_terms() -> None:
    task = Walker(WalkerConfig(episode_seconds=1.0), 2, seed=1)
    assert task.observation_shape == (3 + 3 + 3 + 3 + 12 + 12 + 4 + 2 + 12 + 6,)
    command = task.observations[:, 9:12].clone()
    seen, turns = set(), []
    for step in range(30):
        task.step(0.2 * torch.sin(torch.arange(24.0).reshape(2, 12) + step))
        assert torch.isfinite(task.observations).all() and torch.isfinite(task.rewards).all()
        seen |= {tuple(row) for row in task.observations[:, 9:11].tolist()}
        turns.append(task.observations[:, 11].abs().max().item())
    assert len(seen) > 6, "commands are drawn anew every 0.1 to 0.2 s"
    assert max(turns) <= 1.0 and (command.abs() <= 1.0).all()
    last = 0.2 * torch.sin(torch.arange(24.0).reshape(2, 12) + 29)
    alive = ~task.dones
    torch.testing.assert_close(task.observations[alive, 24:36], last[alive])
    joints = task.worlds.arrays.joint_q.numpy()[:, 7:]
    bias = task.observations[:, 12:24].numpy() - (joints - np.tile([0.0, 0.8, -1.6], 4))
    assert np.abs(bias).max() <= 0.0201 and np.ptp(bias) > 0.01, "encoders are off by up to 0.02 rad, each by its own"
