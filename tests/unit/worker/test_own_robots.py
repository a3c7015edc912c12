"""The quadruped and the ant on the CPU: they stand, fall, follow commands and stay within the solver's capacity."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.support.worker.tasks import observe, play, put, statistics
from worker.tasks.library.ant import Ant, AntConfig
from worker.tasks.library.quadruped import Quadruped, QuadrupedConfig

STAND = [0.0, 0.8, -1.6] * 4


@pytest.fixture(scope="module")
def quadruped() -> Quadruped:
    return Quadruped(QuadrupedConfig(episode_seconds=2.0, command_seconds=0.1), 12, seed=1)


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
    pitched, rolled = (half * math.sin(0.3) + 0.055 * math.cos(0.3) for half in (0.19, 0.09))
    touching = [(0.055, 0.0, 0.0, 0.0), (pitched, 0.0, 0.3, 0.0), (pitched, 2.0, 0.3, 0.0), (rolled, 0.0, 0.0, 0.3)]
    places = [(height + edge, *turn) for height, *turn in touching for edge in (-1e-3, 1e-3)]
    places += [(1.0, 0.0, 1.01, 0.0), (1.0, 0.0, 0.99, 0.0)]
    poses = [[0.0, 0.0, height, *Rotation.from_euler("ZYX", turn).as_quat(), *STAND] for height, *turn in places]
    put(quadruped, joint_q=poses)
    observe(quadruped)
    assert quadruped.dones.tolist() == [*[True, False] * 5, False, False] and not quadruped.time_outs.any()
    assert statistics(quadruped)["reward_fall"] == -10.0


def test_random_ones_stay_finite_within_the_solvers_capacity(quadruped: Quadruped) -> None:
    put(quadruped)
    steps = play(quadruped, 150, seed=2)
    assert all(step[0].isfinite().all() and step[1].isfinite().all() for step in steps)
    totals = statistics(quadruped)
    assert totals["episodes"] > 12 and totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0


@pytest.fixture(scope="module")
def ant() -> Ant:
    return Ant(AntConfig(episode_seconds=0.5), 8, seed=1)


def test_ants_stand_and_random_ones_stay_finite(ant: Ant) -> None:
    put(ant)
    for _ in range(29):
        ant.step(torch.zeros(8, 8))
        assert not ant.dones.any()
    assert (ant.observations[:, 0] > 0.4).all() and (ant.observations[:, 9] > 0.95).all()
    assert all(step[0].isfinite().all() for step in play(ant, 60, seed=2))
    totals = statistics(ant)
    assert totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0


def test_overflow_of_the_solver_is_counted() -> None:
    """Four feet on the ground need 16 rows; give the solver 10."""

    class Cramped(Ant):
        solver_options = {**Ant.solver_options, "njmax": 10}

    cramped = Cramped(AntConfig(), 2, seed=1)
    for _ in range(20):
        cramped.step(torch.zeros(2, 8))
    assert 0 < statistics(cramped)["solver_overflows"] <= 40
