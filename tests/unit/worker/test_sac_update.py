"""SAC's critics, policy and temperature against numbers worked out by hand, by loops, and by torch."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from tests.support.worker.loop import alone, iterate
from tests.support.worker.sac import SMALL, make, point, same
from worker.learning.algorithm import LearningSetting, Spaces, Transition, WorldShare
from worker.learning.sac import kernels
from worker.learning.sac.networks import Critics, SquashedGaussianActor
from worker.learning.sac.replay_buffer import Batch
from worker.learning.sac.sac import SAC
from worker.settings.sac import SACConfig

torch.set_num_threads(1)


def projection_by_loop(
    probabilities: torch.Tensor, returns: float, discount: float, bonus: float, least: float, greatest: float
) -> list[float]:
    """Algorithm 1 of arXiv:1707.06887, atom by atom, in Python's double precision."""
    atoms = len(probabilities)
    gap = (greatest - least) / (atoms - 1)
    result = [0.0] * atoms
    for j, probability in enumerate(probabilities.tolist()):
        place = min(max(returns + discount * (least + j * gap + bonus), least), greatest)
        b = (place - least) / gap
        lower = min(int(b), atoms - 2)
        result[lower] += probability * (lower + 1 - b)
        result[lower + 1] += probability * (b - lower)
    return result


@pytest.mark.parametrize(("least", "greatest", "atoms"), [(-3.0, 5.0, 9), (-20.0, 20.0, 101), (0.0, 1.0, 2)])
def test_projection_against_a_loop(least: float, greatest: float, atoms: int) -> None:
    torch.manual_seed(0)
    samples, span = 300, greatest - least
    probabilities = (3.0 * torch.randn(samples, atoms)).softmax(1)
    returns = span * torch.randn(samples)
    discounts = torch.rand(samples)
    discounts[:60], discounts[60:120], discounts[120:140], discounts[140:160] = 0.0, 1.0, 0.002, 1e-4
    returns[:20] = least + span / (atoms - 1) * torch.randint(0, atoms, (20,))  # on an atom
    returns[60:80] = 0.0
    bonuses = 0.2 * torch.randn(samples)
    nothing = torch.full((samples, atoms), float("nan"))
    found = kernels.project(probabilities, returns, discounts, bonuses, least, greatest, nothing)
    numbers = zip(probabilities, returns.tolist(), discounts.tolist(), bonuses.tolist(), strict=True)
    expected = torch.tensor([projection_by_loop(*each, least, greatest) for each in numbers])
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(found.sum(1), torch.ones(samples), atol=1e-5, rtol=0)


@pytest.mark.parametrize("combine", ["mean", "min"])
def test_how_critics_are_combined(combine: Any) -> None:
    config = SACConfig(atoms=3, v_min=0.0, v_max=2.0, critics=2, combine=combine, critic_sizes=(4,))
    critics = Critics(config, 2, 1)
    # means ¾ 2, 1¼ 1½
    supplied = torch.tensor([[[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]], [[0.25, 0.25, 0.5], [0.0, 0.5, 0.5]]])
    outputs = supplied.clamp(min=1e-30).log()
    together = {"mean": [1.0, 1.75], "min": [0.75, 1.5]}[combine]
    torch.testing.assert_close(critics.combined_mean(outputs), torch.tensor(together))
    chosen = {"mean": supplied.mean(0), "min": torch.stack((supplied[0, 0], supplied[1, 1]))}[combine]
    torch.testing.assert_close(critics.combined_distribution(outputs), chosen)
    single = Critics(dataclasses.replace(config, atoms=1), 2, 1)
    mean = single.combined_mean(torch.tensor([[[1.0], [4.0]], [[3.0], [2.0]]]))
    assert mean.tolist() == ([2.0, 3.0] if combine == "mean" else [1.0, 2.0])


def test_log_probabilities_are_those_of_torch() -> None:
    torch.manual_seed(0)
    actor = SquashedGaussianActor(dataclasses.replace(SMALL, action_limit=2.0), 3, 2)
    with torch.no_grad():
        actor.head.weight.normal_()
    observations, noise = torch.randn(50, 3), torch.randn(50, 2)
    actions, log_prob = actor.sample(observations, noise)
    mean, log_std = actor.spread(observations)
    squashed = TransformedDistribution(Normal(mean.double(), log_std.double().exp()), [TanhTransform()])
    inner = torch.tanh(mean.double() + log_std.double().exp() * noise.double())
    torch.testing.assert_close(actions.double(), 2.0 * inner, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(log_prob.double(), squashed.log_prob(inner).sum(1), atol=1e-3, rtol=1e-3)


def batch_of(sac: SAC, samples: int, observations: int = 2, actions: int = 1) -> Batch:
    torch.manual_seed(7)
    return Batch(
        before=torch.randn(samples, observations + actions).clamp(-0.9, 0.9),
        after=torch.randn(samples, observations),
        returns=torch.randn(samples),
        discounts=0.9 * (torch.rand(samples) > 0.2).float(),
    )


@pytest.mark.parametrize("atoms", [1, 11])
def test_the_gradients_of_an_update_are_those_of_its_losses(atoms: int) -> None:
    sac = make(point(), atoms=atoms, normalize_observations=False, init_temperature=0.3, target_entropy=-0.5)
    learner = sac.learner
    batch, noise = batch_of(sac, 24), torch.randn(2, 24, 1)
    learner.compute(batch, noise, True)
    found = [[p.grad.clone() for p in net.parameters()] for net in (learner.critics, learner.actor)]
    losses, temperature_gradient = learner.losses.clone(), learner.log_temperature.grad.clone()

    actor, critics = copy.deepcopy(learner.actor), copy.deepcopy(learner.critics)
    following, log_prob = actor.sample(batch.after, noise[0])
    after = learner.targets(batch.after, following)
    outputs = critics(batch.before[:, :2], batch.before[:, 2:])
    if atoms == 1:
        target = batch.returns + batch.discounts * (after[..., 0].mean(0) - 0.3 * log_prob)
        critic_loss = sum((each[:, 0] - target.detach()).square().mean() for each in outputs)
    else:
        numbers = (batch.returns.tolist(), batch.discounts.tolist(), (-0.3 * log_prob).tolist())
        rows = zip(after.softmax(-1).mean(0).detach(), *numbers, strict=True)
        target = torch.tensor([projection_by_loop(*row, -5.0, 15.0) for row in rows])
        critic_loss = sum(torch.nn.functional.cross_entropy(each, target) for each in outputs)
    expected = torch.autograd.grad(critic_loss, [*critics.parameters()])
    torch.testing.assert_close(found[0], [*expected], atol=1e-5, rtol=1e-3)

    chosen, log_prob = actor.sample(batch.before[:, :2], noise[1])
    value = critics.mean(critics(batch.before[:, :2], chosen)).mean(0)
    policy_loss = (0.3 * log_prob - value).mean()
    expected = torch.autograd.grad(policy_loss, [*actor.parameters()])
    torch.testing.assert_close(found[1], [*expected], atol=1e-5, rtol=1e-3)
    torch.testing.assert_close(temperature_gradient, (0.3 * (-log_prob + 0.5)).mean().detach())
    q_mean = critics.mean(outputs).mean()
    torch.testing.assert_close(losses, torch.stack((policy_loss, -log_prob.mean(), critic_loss, q_mean)).detach())


def test_only_critics_learn_between_the_updates_of_the_policy() -> None:
    sac = make(point(), tau=0.25)
    learner = sac.learner
    policy, critics, targets = (
        copy.deepcopy(each.state_dict()) for each in (learner.actor, learner.critics, learner.targets)
    )
    learner.compute(batch_of(sac, 24), torch.randn(2, 24, 1), False)
    learner.apply(False)
    assert same(policy, learner.actor.state_dict())
    assert learner.losses[:2].tolist() == [0.0, 0.0]
    assert float(learner.temperature) == pytest.approx(SMALL.init_temperature)
    for name, now in learner.critics.state_dict().items():
        assert not torch.equal(now, critics[name])
        torch.testing.assert_close(learner.targets.state_dict()[name], targets[name] + 0.25 * (now - targets[name]))


def test_gradients_are_clipped_by_their_norm() -> None:
    sac = make(point(), max_grad_norm=0.1)
    learner = sac.learner
    learner.compute(batch_of(sac, 24), torch.randn(2, 24, 1), True)
    before = learner._critic_gradient.clone()
    assert before.norm() > 0.1
    learner.apply(True)
    torch.testing.assert_close(learner._critic_gradient, before * 0.1 / before.norm(), rtol=1e-4, atol=1e-7)


def test_critics_may_have_observations_that_the_policy_lacks() -> None:
    setting = LearningSetting(Spaces({"policy": (2,), "critic": (3,)}, 1), WorldShare(0, 4, 4), alone(), 0)
    sac = SAC(dataclasses.replace(SMALL, critic_group="critic", warm_up=0), setting)
    assert sac.learner.critics.each[0][0].in_features == 4 and sac.learner.actor.body[0].in_features == 2
    torch.manual_seed(0)

    def look() -> TensorDict:
        return TensorDict({"policy": torch.randn(4, 2), "critic": 5.0 + torch.randn(4, 3)}, batch_size=[4])

    seen = [look()]
    sac.begin(0)
    for _ in range(4):
        sac.act(seen[-1])
        ended, seen = look(), [*seen, look()]
        nothing = torch.zeros(4, dtype=torch.bool)
        sac.record(Transition(seen[-1], ended, torch.ones(4), nothing, nothing))
    for step in range(4):
        expected = torch.cat((seen[step]["policy"], seen[step]["critic"]), 1)
        assert torch.equal(sac.replay.before[step, :, :5], expected)
        assert torch.equal(sac.replay.after[step], torch.cat((seen[step + 1]["policy"], seen[step + 1]["critic"]), 1))
    assert all(value.isfinite() for value in sac.learn(seen[-1]).values())
    stacked = torch.stack([each["critic"] for each in seen[:4]]).flatten(0, 1)
    torch.testing.assert_close(sac.learner.normalizers[1].mean, stacked.mean(0))
    assert set(sac.policy().state_dict()) == set(SAC.build_policy(sac.config, setting.spaces, "cpu").state_dict())


@pytest.mark.parametrize(("least", "greatest", "mass"), [(-200.0, -199.0, 1.0), (-20.0, 20.0, 0.0)])
def test_the_mass_at_v_max_shows_returns_that_the_critics_cannot_tell_apart(
    least: float, greatest: float, mass: float
) -> None:
    """Each step costs the point a few units at most, so that returns are above −199, where the first range ends."""
    algorithm = make(point(), v_min=least, v_max=greatest)
    metrics = iterate(algorithm, point(), 0, 4)
    assert float(metrics["v_max_mass"]) == pytest.approx(mass, abs=0.1)
    assert float(metrics["gradient_norm"]) > 0.0
    actor = algorithm.learner.actor
    spread = actor.spread(actor.normalizer(point().observations))[1].exp().mean()
    assert float(metrics["action_std"]) == pytest.approx(float(spread), rel=0.1)
    assert "v_max_mass" not in iterate(make(point(), atoms=1), point(), 0, 1)
