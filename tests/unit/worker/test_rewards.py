"""Reward terms: named and weighted by the configuration, from a job's YAML or from Python."""

from __future__ import annotations

import math

import gymnasium
import pytest
import torch

from tests.support.worker.tasks import observe, put, statistics
from worker.errors import UserError
from worker.learning.job import configure
from worker.tasks.ant import Ant, AntConfig
from worker.tasks.cartpole import Cartpole, CartpoleConfig


def test_a_yaml_changes_the_weights_that_it_names() -> None:
    config = configure(Ant, {"config": {"rewards": {"forward": 2, "fall": -7.5}}})
    assert config.rewards == {**AntConfig().rewards, "forward": 2.0, "fall": -7.5}
    assert tuple(config.rewards) == Ant.reward_terms, "the order is the kernel's, whatever the YAML's"
    assert configure(Ant, {}).rewards == AntConfig().rewards
    with pytest.raises(TypeError):
        config.rewards["forward"] = 3.0  # type: ignore[index]


@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        (
            {"foward": 1.0},
            "train.config.rewards.foward: AntConfig has no term 'foward'; did you mean forward?",
        ),
        (
            {"xyz": 1.0},
            "train.config.rewards.xyz: AntConfig has no term 'xyz'; there are forward, heading, up, alive, action, energy",
        ),
        ({7: 1.0}, "train.config.rewards.7: expected a text, found a whole number (7)"),
        ({"forward": "much"}, "train.config.rewards.forward: expected a number, found a text ('much')"),
        ({"forward": True}, "train.config.rewards.forward: expected a number, found true or false (True)"),
        ({"forward": math.nan}, "train.config.rewards.forward: expected a finite number, found a number (nan)"),
        ({"up": math.inf}, "train.config.rewards.up: expected a finite number, found a number (inf)"),
        ({"up": None}, "train.config.rewards.up: expected a number, found nothing"),
        ([1.0], "train.config.rewards: expected a mapping, found a list"),
    ],
)
def test_an_impossible_weight_is_refused_in_one_line(rewards: object, message: str) -> None:
    with pytest.raises(UserError) as refusal:
        configure(Ant, {"config": {"rewards": rewards}})
    assert str(refusal.value).startswith(message) and "\n" not in str(refusal.value)


def test_terms_are_weighted_in_the_kernel_and_logged_one_by_one() -> None:
    task = Cartpole(CartpoleConfig(rewards={"alive": 3.0, "position": 0.0, "velocity": -2.0}), 2, seed=1)
    put(task, joint_q=[[2.0, 0.3], [-2.5, 0.0]], joint_qd=[[-0.5, 3.0], [0.0, 0.0]])
    task.actions[:, 0] = torch.tensor([0.5, 0.0])
    observe(task)
    # alive 3, minus 0.1 angle^2, no position, minus 2 velocity^2, minus 0.001 action^2
    assert task.rewards[0].item() == pytest.approx(3.0 - 0.009 - 0.5 - 0.00025, abs=1e-6)
    assert task.rewards[1].item() == -2.0
    assert task.state_dict()["episode_sums"][0, 2:].tolist() == pytest.approx([3.0, -0.009, 0.0, -0.5, -0.00025, 0.0])
    totals = statistics(task)
    assert totals["reward_fall"] == -2.0 and totals["reward_position"] == 0.0


def test_gymnasium_sets_them_too() -> None:
    worlds = gymnasium.make_vec("worker.tasks.gym:Muster/Cartpole-v0", num_envs=2, rewards={"alive": 5.0})
    assert worlds.unwrapped.task.config.rewards == {**CartpoleConfig().rewards, "alive": 5.0}
    worlds.close()
    with pytest.raises(ValueError, match="did you mean alive"):
        gymnasium.make_vec("worker.tasks.gym:Muster/Cartpole-v0", num_envs=2, rewards={"alife": 5.0})
