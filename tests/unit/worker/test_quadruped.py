"""The quadruped on the CPU: observation and reward by hand, commands, drives, falls."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import warp as wp

from tests.support.worker.tasks import observe, play, put, statistics
from worker.errors import UserError
from worker.learning.job import configure
from worker.tasks import find_task
from worker.tasks.quadruped import Quadruped, QuadrupedConfig

STAND = [0.0, 0.8, -1.6] * 4
LEVEL = [0.0, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def quadruped() -> Quadruped:
    return Quadruped(QuadrupedConfig(episode_seconds=2.0, command_seconds=0.1), 12, seed=1)


def test_it_is_found_and_its_sizes_are_those_of_its_names(quadruped: Quadruped) -> None:
    assert find_task("Quadruped") is Quadruped
    assert (quadruped.observation_shape, quadruped.action_size) == ((48,), 12)
    assert len(set(quadruped.observation_names)) == 48
    labels = [label.rsplit("/", 1)[-1] for label in quadruped.worlds.model.joint_label[1:13]]
    assert labels == list(quadruped.action_names)
    assert QuadrupedConfig().control_hz == 50 and quadruped.worlds.timestep == pytest.approx(1 / 200)


def test_it_stands_by_itself() -> None:
    config = QuadrupedConfig(start_angle_noise=0.0, start_velocity_noise=0.0, command_stand=1.0)
    task = Quadruped(config, 2, seed=1)
    for _ in range(250):
        task.step(torch.zeros(2, 12))
        assert not task.dones.any()
    heights = task.worlds.arrays.joint_q.numpy()[:, 2]
    assert (heights > 0.26).all() and (heights < 0.315).all(), (
        "it sinks a little into its drives' targets, and stays up"
    )
    assert (task.observations[:, 8] < -0.99).all() and (task.observations[:, :6].abs() < 0.01).all()
    assert (task.observations[:, 9:12] == 0).all()
    # four legs carry 14 kg: the vertical forces of the feet come from the drives, 5 N m on each knee or so
    knees = task.worlds.arrays.drives.numpy()[:, 8::3]
    assert (np.abs(knees) > 3.0).all() and (np.abs(knees) < 8.0).all()


def test_every_action_moves_the_target_of_the_joint_that_it_is_named_after(quadruped: Quadruped) -> None:
    put(quadruped, joint_q=[[0.0, 0.0, 3.0, *LEVEL, *STAND]] * 12, joint_qd=[[0.0] * 18] * 12)
    quadruped.step(2.0 * torch.eye(12))
    targets = quadruped.worlds.arrays.controls.numpy()
    assert np.allclose(targets, np.array(STAND) + 0.5 * np.eye(12), atol=1e-6), "actions are clipped to 1, then scaled"
    velocities = quadruped.observations[:, 24:36]
    assert velocities.argmax(dim=1).tolist() == list(range(12))
    assert (quadruped.observations[:, 36:] == torch.eye(12)).all()


def test_observation_and_reward_by_hand(quadruped: Quadruped) -> None:
    """Turned by 90 degrees about z, moving along +y (its own forward) at 0.8 m/s, turning at 0.5 rad/s."""
    half = math.sqrt(0.5)
    joints = list(STAND)
    joints[2] = -0.85  # 5 cm from its end at -0.8, whose last twentieth begins at -0.885
    joints[4] = 1.0
    last = [0.25, *[0.0] * 11]
    put(
        quadruped,
        joint_q=[[1.0, 2.0, 0.3, 0.0, 0.0, half, half, *joints]],
        joint_qd=[[0.1, 0.8, 0.2, 0.3, 0.0, 0.5, 4.0, *[0.0] * 11]],
        memory=[[1.0, 0.0, 0.25, 3.0]],
        last_actions=[last],
    )
    torques = wp.to_torch(quadruped.worlds.arrays.drives)
    torques.zero_()
    torques[0, 6:8] = torch.tensor([3.0, -4.0])
    quadruped.actions.zero_()
    quadruped.actions[0, 0] = 5.0
    observe(quadruped)
    seen = dict(zip(quadruped.observation_names, quadruped.observations[0].tolist(), strict=True))
    assert [seen[f"trunk_velocity_{axis}"] for axis in "xyz"] == pytest.approx([0.8, -0.1, 0.2], abs=1e-5)
    assert [seen[f"trunk_angular_velocity_{axis}"] for axis in "xyz"] == pytest.approx([0.0, -0.3, 0.5], abs=1e-5)
    assert [seen[f"gravity_{axis}"] for axis in "xyz"] == pytest.approx([0, 0, -1], abs=1e-6)
    assert [seen[f"command_{name}"] for name in ("forward", "left", "turn")] == [1.0, 0.0, 0.25]
    assert seen["front_left_knee_position"] == pytest.approx(0.75, abs=1e-6)
    assert seen["front_right_thigh_position"] == pytest.approx(0.2, abs=1e-6)
    assert seen["front_left_hip_velocity"] == pytest.approx(0.2)
    assert seen["front_left_hip_previous_action"] == 1.0
    names = [*quadruped.reward_terms, *quadruped.metric_names]
    terms = dict(zip(names, quadruped.state_dict()["episode_sums"][0, 2:].tolist(), strict=True))
    expected = {
        "track_linear": 2.0 * math.exp(-4 * (0.2**2 + 0.1**2)),
        "track_angular": math.exp(-4 * 0.25**2),
        "lin_vel_z": -2.0 * 0.2**2,
        "ang_vel_xy": -0.05 * 0.3**2,
        "orientation": 0.0,
        "torques": -1.0e-4 * (9.0 + 16.0),
        "action_rate": -0.01 * 4.75**2,
        "pose": -0.05 * (0.75**2 + 0.2**2),
        "limits": -5.0 * (-0.85 + 0.885),
        "fall": 0.0,
    }
    for name, value in expected.items():
        assert terms[name] == pytest.approx(value / 50, abs=1e-6), name
    assert quadruped.rewards[0].item() == pytest.approx(sum(expected.values()) / 50, abs=1e-6)
    assert terms["metric_error_vel_xy"] == pytest.approx(math.hypot(1.0 - 0.8, 0.1), abs=1e-5)
    assert terms["metric_error_vel_yaw"] == pytest.approx(0.5 - 0.25, abs=1e-6)


def test_a_state_that_was_saved_before_there_were_metrics_is_continued_with_zeros_for_their_sums(
    quadruped: Quadruped,
) -> None:
    quadruped.step(torch.ones(12, 12))
    state = quadruped.state_dict()
    rewards = 2 + len(quadruped.reward_terms)
    quadruped.load_state_dict({**state, "episode_sums": state["episode_sums"][:, :rewards]})
    sums = quadruped.state_dict()["episode_sums"]
    assert torch.equal(sums[:, :rewards], state["episode_sums"][:, :rewards]) and (sums[:, rewards:] == 0).all()
    with pytest.raises(ValueError, match=r"episode_sums is \(12, 11\) torch\.float32, expected \(12, 14\)"):
        quadruped.load_state_dict({**state, "episode_sums": state["episode_sums"][:, :11]})
    quadruped.load_state_dict(state)


def test_a_trunk_on_the_ground_or_tilted_ends_the_episode(quadruped: Quadruped) -> None:
    """The trunk is 0.38 x 0.18 x 0.11 m: level it touches at 0.055 m, pitched by 0.3 rad at 0.109 m, rolled at 0.079."""

    def pitched(height: float, angle: float, yaw: float = 0.0) -> list[float]:
        a, b = angle / 2, yaw / 2
        quaternion = [-math.sin(a) * math.sin(b), math.sin(a) * math.cos(b), math.cos(a) * math.sin(b)]
        return [0.0, 0.0, height, *quaternion, math.cos(a) * math.cos(b), *STAND]

    corner = 0.19 * math.sin(0.3) + 0.055 * math.cos(0.3)
    poses = [pitched(0.054, 0.0), pitched(0.056, 0.0), pitched(corner - 1e-3, 0.3), pitched(corner + 1e-3, 0.3)]
    poses += [
        pitched(corner - 1e-3, 0.3, 2.0),
        pitched(corner + 1e-3, 0.3, 2.0),
        pitched(1.0, 1.01),
        pitched(1.0, 0.99),
    ]
    side = 0.09 * math.sin(0.3) + 0.055 * math.cos(0.3)
    rolled = [math.sin(0.15), 0.0, 0.0, math.cos(0.15)]
    poses += [[0.0, 0.0, height, *rolled, *STAND] for height in (side - 1e-3, side + 1e-3)]
    put(quadruped, joint_q=poses)
    observe(quadruped)
    assert quadruped.dones.tolist() == [*[True, False] * 5, False, False] and not quadruped.time_outs.any()
    assert statistics(quadruped)["reward_fall"] == -10.0
    assert quadruped.terminal_observations[6, 6].item() == pytest.approx(math.sin(1.01), abs=1e-5)
    assert (quadruped.observations[[0, 2, 4, 6], 36:] == 0).all(), "a new episode has no previous action"


def test_commands_hold_for_their_time_and_lie_in_their_ranges() -> None:
    config = QuadrupedConfig(
        command_forward=(0.2, 0.4), command_left=(0.0, 0.0), command_turn=(-2.0, -1.0), command_seconds=0.1
    )
    task = Quadruped(config, 64, seed=3)
    seen = [task.observations[:, 9:12].clone()]
    for _ in range(20):
        task.step(torch.zeros(64, 12))
        assert not task.dones.any()
        seen.append(task.observations[:, 9:12].clone())
    assert all(torch.equal(seen[step], seen[step - step % 5]) for step in range(20)), "a command holds for 5 steps"
    drawn = torch.cat(seen[::5])
    still = (drawn == 0).all(dim=1)
    assert 0.02 < still.double().mean() < 0.25, "one in ten asks to stand still"
    moving = drawn[~still]
    assert (moving[:, 0] >= 0.2).all() and (moving[:, 0] <= 0.4).all() and (moving[:, 1] == 0).all()
    assert (moving[:, 2] >= -2.0).all() and (moving[:, 2] <= -1.0).all()
    assert len(moving[:, 0].unique()) > 0.9 * len(moving)


def test_random_ones_stay_finite_within_the_solvers_capacity(quadruped: Quadruped) -> None:
    put(quadruped)
    steps = play(quadruped, 150, seed=2)
    assert all(step[0].isfinite().all() and step[1].isfinite().all() for step in steps)
    totals = statistics(quadruped)
    assert totals["episodes"] > 12 and totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"command_turn": [1.0, -1.0]}, "train.config.command_turn: expected [least, greatest], found [1.0, -1.0]"),
        ({"command_turn": [1.0]}, "train.config.command_turn: expected [least, greatest], found [1.0]"),
        ({"command_turn": [0.0, math.inf]}, "train.config.command_turn: expected [least, greatest], found [0.0, inf]"),
        ({"command_stand": 2}, "train.config.command_stand: expected a value less than or equal to 1, found 2"),
        ({"command_seconds": 0}, "train.config.command_seconds: expected a value greater than 0, found 0"),
    ],
)
def test_impossible_commands_are_refused_in_one_line(config: dict, message: str) -> None:
    with pytest.raises(UserError) as refusal:
        configure(Quadruped, {"config": config})
    assert str(refusal.value) == message
