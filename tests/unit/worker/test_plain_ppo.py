"""The fused PPO computes what a PPO in one plain file does, over whole iterations; and that file by itself.

Both see the same random numbers and begin with the same weights. What differs is the order of sums, and so float32's rounding, which
Adam's division makes greatest in the weights: their tolerance is 1e-3 of the value, or 2e-5. Learning rates are compared to 1e-5,
where a decision taken otherwise would be a factor of 1.5.
"""

from __future__ import annotations

import copy
import dataclasses
import threading
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from tests.support.refusals import refusal
from tests.support.worker.loop import alone, groups, iterate, setting_of, spaces_of
from tests.support.worker.plain_ppo import Network, PlainPPO
from tests.support.worker.point_task import Point, PointConfig, PointPPO
from worker.learning.algorithm import LearningSetting, Spaces, Transition, WorldShare
from worker.learning.distributed import Gang, RankPlacement
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


class Part(Gang):
    """One of several ranks that are threads of this process."""

    def __init__(self, rank: int, shared: list[torch.Tensor], meeting: threading.Barrier) -> None:
        super().__init__(RankPlacement(rank=rank, world_size=len(shared)), "cpu", None, ["here"] * len(shared))
        self.shared, self.meeting = shared, meeting

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        self.shared[self.rank] = tensor.clone()
        self.meeting.wait(60)
        tensor.copy_(torch.stack(self.shared).sum(0))
        self.meeting.wait(60)
        return tensor

    def broadcast(self, tensor: torch.Tensor) -> torch.Tensor:
        self.shared[self.rank] = tensor.clone()
        self.meeting.wait(60)
        tensor.copy_(self.shared[0])
        self.meeting.wait(60)
        return tensor


def test_two_ranks_learn_the_same_as_the_fused_one_alone() -> None:
    """Worlds 0 and 1, and worlds 2 to 5; ranks draw weights of their own, which the main rank's replace."""
    torch.manual_seed(8)
    whole = Point(PointConfig(), WORLDS, seed=2)
    fused, plain = twins(setting_of(whole, seed=4), epochs=3, minibatches=4)
    shared, meeting = [torch.zeros(())] * 2, threading.Barrier(2)
    began: dict[int, list[torch.Tensor]] = {}
    ended: dict[int, tuple[Watched, dict[str, torch.Tensor]]] = {}

    def rank(number: int, share: WorldShare) -> None:
        try:
            task = Point(PointConfig(), share.count, seed=2, first_world=share.first)
            gang = Part(number, shared, meeting)
            meeting.wait(60)
            part = Watched(plain.config, LearningSetting(spaces_of(task), share, gang, 4))
            began[number] = [parameter.detach().clone() for parameter in part.parameters]
            part.actor.load_state_dict(plain.actor.state_dict())
            part.critic.load_state_dict(plain.critic.state_dict())
            ended[number] = part, iterate(part, task, 0, 3)
        except BaseException:
            meeting.abort()
            raise

    shares = WorldShare(0, 2, WORLDS), WorldShare(2, 4, WORLDS)
    threads = [threading.Thread(target=rank, args=(number, share)) for number, share in enumerate(shares)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    learnt = iterate(fused, whole, 0, 3)
    assert sorted(ended) == [0, 1] and all(map(torch.equal, began[0], began[1]))
    (one, said), (other, too) = ended[0], ended[1]
    assert said == too and all(map(torch.equal, one.parameters, other.parameters)), "all ranks hold the same bits"
    for ours, its in ((one.actor, fused.actor), (one.critic, fused.critic)):
        for name, tensor in its.mlp.state_dict().items():
            torch.testing.assert_close(ours.layers.state_dict()[name], tensor, **OF_WEIGHTS, msg=name)
        torch.testing.assert_close(ours.variance, its.obs_normalizer._var[0], **ROUNDING)
    assert {name: float(value) for name, value in said.items()} == pytest.approx(
        {name: float(value) for name, value in learnt.items()}, rel=1e-3, abs=1e-5
    )


def test_it_goes_on_from_its_state_with_the_same_bits() -> None:
    def started(seed: int) -> tuple[PlainPPO, Point]:
        torch.manual_seed(seed)
        task = Point(PointConfig(), 4, seed=2)
        return PlainPPO(PointPPO(), setting_of(task, seed=4)), task

    (straight, its), (stopped, left) = started(1), started(1)
    iterate(straight, its, 0, 4)
    iterate(stopped, left, 0, 2)
    resumed, task = started(2)
    assert resumed.load_state_dict(copy.deepcopy(stopped.state_dict())) == []
    task.load_state_dict(left.state_dict())
    iterate(resumed, task, 2, 4)
    assert resumed.rate == straight.rate
    for ours, others in ((resumed.actor, straight.actor), (resumed.critic, straight.critic)):
        for name, tensor in ours.state_dict().items():
            assert torch.equal(tensor, others.state_dict()[name]), name
    set_anew, _ = started(3)
    asked = dataclasses.replace(set_anew.config, learning_rate=2e-4)
    set_anew.config = asked
    assert set_anew.load_state_dict(stopped.state_dict(), changed={"learning_rate"}) == ["learning rate set to 0.0002"]
    fresh, _ = started(3)
    fresh.load_state_dict(stopped.state_dict(), weights_only=True)
    assert not fresh.optimizer.state and fresh.rate == fresh.config.learning_rate
    policy = PlainPPO.build_policy(PointPPO(), spaces_of(task), "cpu")
    policy.load_state_dict(straight.state_dict()["policy"])
    assert torch.equal(policy.act(groups(its)), straight.policy().act(groups(its)))
    exported = policy.module()
    with torch.no_grad():
        assert torch.equal(exported.network(exported.sample["policy"]), policy.act(exported.sample))


def test_an_unsupported_setting_is_refused_with_an_alternative() -> None:
    def refused(spaces: Spaces, **settings: Any) -> str:
        setting = LearningSetting(spaces, WorldShare(0, 2, 2), alone(), 0)
        return refusal(PlainPPO, dataclasses.replace(PointPPO(), **settings), setting)

    numbers = {"policy": (2,)}
    assert "choices nor images; algorithm ppo has both" in refused(Spaces(numbers, 3, discrete=True))
    image = {"policy": (3, 8, 8), "critic": (2,)}
    assert "choices nor images; algorithm ppo has both" in refused(Spaces(image, 1), critic_observations="critic")
    assert "critic_observations: " in (said := refused(Spaces(image, 1))) and "algorithm ppo" in said
    assert "no numbers 'critic'" in refused(Spaces(numbers, 1), critic_observations="critic")
    assert "algorithm ppo has adamw" in refused(Spaces(numbers, 1), optimizer="adamw")
    assert "minibatches: 9 are more than the 8 steps" in refused(Spaces(numbers, 1), minibatches=9)


def test_a_normaliser_has_the_moments_of_all_that_it_has_seen() -> None:
    torch.manual_seed(2)
    seen = 3.0 * torch.randn(5, 12, 2) + torch.tensor([4.0, -100.0])
    network = Network(2, (4,), 1, PointPPO())
    setting = LearningSetting(Spaces({"policy": (2,)}, 1), WorldShare(0, 4, 4), alone(), 0)
    for part in seen:
        network.update_normalizer(part, setting)
    together = seen.flatten(0, 1)
    assert int(network.count) == 60
    torch.testing.assert_close(network.mean, together.mean(0))
    torch.testing.assert_close(network.variance, together.var(0, unbiased=False), rtol=1e-4, atol=1e-4)
