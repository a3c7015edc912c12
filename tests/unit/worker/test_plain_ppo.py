"""The fused PPO computes what a PPO in one plain file does, over whole iterations; and that file by itself.

Both see the same random numbers and begin with the same weights. What differs is the order of sums, and so float32's rounding, which
Adam's division makes greatest in the weights: their tolerance is 1e-3 of the value, or 2e-5. Learning rates are compared to 1e-5,
where a decision taken otherwise would be a factor of 1.5.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from tests.support.worker.loop import alone
from tests.support.worker.plain_ppo import PlainPPO
from tests.support.worker.point_task import PointPPO
from worker.learning.algorithm import LearningSetting, Spaces, Transition, WorldShare
from worker.learning.ppo.fused import PPO
from worker.learning.ppo.heads import LOSSES

torch.set_num_threads(1)

WORLDS = 6
ROUNDING = dict(rtol=1e-4, atol=1e-5)
"""Of values, advantages and moments; advantages are of a size of 1."""
OF_WEIGHTS = dict(rtol=1e-3, atol=2e-5)


class Watched(PlainPPO):
    """Keeps what an iteration estimated, and the loss of each minibatch."""

    def _estimate(self, observations: TensorDict) -> dict[str, torch.Tensor]:
        self.samples = super()._estimate(observations)
        return self.samples


def twins(setting: LearningSetting, **settings: Any) -> tuple[PPO, Watched]:
    """The two with the same weights."""
    config = dataclasses.replace(PointPPO(), **settings)
    fused, plain = PPO(config, setting), Watched(config, setting)
    with torch.no_grad():
        plain.actor.std.copy_(fused.actor.distribution.std_param)
        for ours, its in ((plain.actor, fused.actor), (plain.critic, fused.critic)):
            ours.layers.load_state_dict(its.mlp.state_dict())
    return fused, plain


def assert_equal(fused: PPO, plain: Watched, learnt: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """After an iteration: estimates, losses, learning rate, weights and moments."""
    rollout = fused.rollout
    for name in ("values", "returns", "advantages", "log_prob"):
        samples = plain.samples["log_probs" if name == "log_prob" else name]
        torch.testing.assert_close(samples, getattr(rollout, name).flatten(), **ROUNDING, msg=name)
    one, other = ({name: float(value) for name, value in each.items()} for each in learnt)
    assert one.keys() == other.keys() >= {*LOSSES, "learning_rate", "action_std"}
    assert one["learning_rate"] == pytest.approx(other["learning_rate"], rel=1e-5)
    for name in one:
        assert one[name] == pytest.approx(other[name], rel=1e-3, abs=1e-5), name
    torch.testing.assert_close(plain.actor.std, fused.actor.distribution.std_param, **OF_WEIGHTS)
    for ours, its in ((plain.actor, fused.actor), (plain.critic, fused.critic)):
        for name, tensor in its.mlp.state_dict().items():
            torch.testing.assert_close(ours.layers.state_dict()[name], tensor, **OF_WEIGHTS, msg=name)
        if fused.config.normalize_observations:
            moments, count = its.obs_normalizer, int(ours.count)
            torch.testing.assert_close(ours.mean, moments._mean[0], **ROUNDING)
            torch.testing.assert_close(ours.variance, moments._var[0], **ROUNDING)
            assert count == int(moments.count) > 0


SETTINGS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "values not clipped": {"clip_values": False},
    "fixed rate": {"schedule": "fixed"},
    "entropy": {"entropy_coef": 0.05},
    "no entropy": {"entropy_coef": 0.0, "value_loss_coef": 0.4},
    "far steps": {"learning_rate": 1e-2, "desired_kl": 0.002, "clip": 0.05},
    "near steps": {"learning_rate": 1e-4, "max_grad_norm": 0.1},
    "steps left over": {"minibatches": 3},
    "critic's own": {"critic_observations": "critic", "critic_hidden_sizes": (24,), "activation": "tanh"},
    "limits of the deviation": {"min_std": 0.98, "max_std": 0.99, "init_std": 0.985, "entropy_coef": 0.3},
    "settled": {"learning_rate": 1e-2, "desired_kl": 1.0, "learning_rate_horizon": 1, "normalizer_horizon": 2},
    "not normalised": {"normalize_observations": False, "init_std": 0.5},
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_both_implementations_learn_the_same_on_random_data(settings: dict[str, Any]) -> None:
    """Three observations and two actions, of sizes far from 1; a quarter of the steps end an episode, half of those by the clock."""
    torch.manual_seed(8)
    spaces = Spaces({"policy": (3,), "critic": (5,)}, 2)
    setting = LearningSetting(spaces, WorldShare(0, WORLDS, WORLDS), alone(), seed=4, action_ranges=((-1.0, 1.0), None))
    fused, plain = twins(setting, **{"epochs": 3, "minibatches": 4, "gamma": 0.95, "lam": 0.9, **settings})
    scale = {"policy": torch.tensor([1.0, 30.0, 0.1]), "critic": torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])}

    def observed() -> TensorDict:
        drawn = {name: size * (torch.randn(WORLDS, len(size)) + 0.5) for name, size in scale.items()}
        return TensorDict(drawn, [WORLDS])

    rates = {fused.config.learning_rate}
    for iteration in range(4):
        observations = observed()
        fused.begin(iteration)
        plain.begin(iteration)
        for _ in range(fused.steps):
            actions = fused.act(observations).clone()
            torch.testing.assert_close(plain.act(observations), actions, **OF_WEIGHTS)
            plain._rollout[-1]["actions"] = (
                actions  # what went before is compared by itself: differences would add up here
            )
            dones = torch.rand(WORLDS) < 0.25
            time_outs = dones & (torch.rand(WORLDS) < 0.5)
            ends = observed()
            for group in ends.values():
                group[~dones] = float("nan")  # nothing may look there
            rewards = 1.0 - actions.square().sum(1) + torch.randn(WORLDS)
            observations = observed()
            for each in (fused, plain):
                each.record(Transition(observations, ends, rewards, dones, time_outs))
        learnt = dict(fused.learn(observations)), plain.learn(observations)
        assert_equal(fused, plain, learnt)
        rates.add(plain.rate)
    if fused.config.schedule == "fixed":
        assert len(rates) == 1
    elif settings.get("learning_rate"):
        assert len(rates) > 1, "the rule was exercised"
