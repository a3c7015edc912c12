"""PPO against numbers worked out by hand, and against rsl-rl's own."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from rsl_rl.algorithms.ppo import PPO as StockPPO
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage.rollout_storage import RolloutStorage
from tensordict import TensorDict

from tests.support.worker.loop import alone, iterate, transition_of
from tests.support.worker.point_task import Point, PointConfig, PointPPO
from worker.learning.algorithm import LearningSetting, Spaces, Transition, WorldShare
from worker.learning.ppo.fused import PPO
from worker.settings.ppo import PPOConfig


def make(worlds: int = 4, first: int = 0, total: int | None = None, **settings: object) -> PPO:
    torch.manual_seed(5)
    share = WorldShare(first, worlds, total or worlds)
    spaces = Spaces({"policy": (2,), "critic": (2,)}, 1)
    return PPO(dataclasses.replace(PointPPO(), **settings), LearningSetting(spaces, share, alone(), 1))


def groups(observations: torch.Tensor) -> TensorDict:
    return TensorDict({"policy": observations, "critic": observations}, [len(observations)])


class FirstComponent(torch.nn.Module):
    """A critic that is known: the value is the first component of the observation."""

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        return latent[..., :1]


def play(
    ppo: PPO, observations: torch.Tensor, rewards: list, dones: list, time_outs: list, terminal: torch.Tensor
) -> None:
    """Put a rollout of one world into ``ppo``."""
    ppo.begin(0)
    for step, (reward, done, time_out) in enumerate(zip(rewards, dones, time_outs, strict=True)):
        ppo.act(groups(observations[step].view(1, 2)))
        flags = (torch.tensor([bool(value)]) for value in (done, time_out))
        ended = groups(terminal[step].view(1, 2))
        ppo.record(Transition(groups(observations[step].view(1, 2)), ended, torch.tensor([float(reward)]), *flags))
    for view in ppo.rollout.views:
        view.last.copy_(observations[-1].view(1, 2))
    ppo._estimate()


# r = (1, 0, 2), V = (1, 2, 3), V after the last step 4, γ = 0.9, λ = 0.5; the second step ends an episode
VALUES = torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
RETURNS = dict(steps=3, gamma=0.9, lam=0.5, minibatches=1, normalize_observations=False)


def test_gae_by_hand() -> None:
    ppo = make(1, **RETURNS)
    ppo.critic.mlp = FirstComponent()
    play(ppo, VALUES, [1, 0, 2], [0, 1, 0], [0, 0, 0], torch.full((3, 2), float("nan")))
    # δ₂ = 2 + 0.9·4 − 3 = 2.6, δ₁ = 0 − 2 = −2 (ended), δ₀ = 1 + 0.9·2 − 1 = 1.8; A = (1.8 + 0.45·(−2), −2, 2.6)
    assert ppo.rollout.returns.flatten().tolist() == pytest.approx([1.9, 0.0, 5.6])
    # mean 0.5, squares of the offsets 0.16 + 6.25 + 4.41, over n − 1 = 2: deviation √5.41
    ppo._normalize()
    expected = [0.4 / 5.41**0.5, -2.5 / 5.41**0.5, 2.1 / 5.41**0.5]
    assert ppo.rollout.advantages.flatten().tolist() == pytest.approx(expected)


def test_a_time_out_bootstraps_from_the_observation_after_the_step() -> None:
    ppo = make(1, **RETURNS)
    ppo.critic.mlp = FirstComponent()
    terminal = torch.tensor([[float("nan"), 0.0], [5.0, 0.0], [float("nan"), 0.0]])
    play(ppo, VALUES, [1, 0, 2], [0, 1, 0], [0, 1, 0], terminal)
    # now δ₁ = 0 + 0.9·5 − 2 = 2.5 and A₀ = 1.8 + 0.45·2.5 = 2.925; V(s_t) = 2 in place of 5 would give −0.2 and 1.71
    assert ppo.rollout.returns.flatten().tolist() == pytest.approx([3.925, 4.5, 5.6])


@pytest.mark.parametrize(("beyond", "within"), [(-0.001, 0.1), (0.05, 0.1), (3.0, 1.0), (0.5, 0.5)])
def test_a_deviation_beyond_its_limits_comes_back_and_learns_again(beyond: float, within: float) -> None:
    """A clamp in the forward pass would have no gradient there: a deviation below its floor would be dead for ever."""
    state = copy.deepcopy(make().state_dict())
    state["policy"]["distribution.std_param"].fill_(beyond)
    ppo = make(entropy_coef=1.0)
    ppo.load_state_dict(state)
    std = ppo.actor.distribution.std_param
    assert std.tolist() == pytest.approx([within])
    task = Point(PointConfig(), 4)
    iterate(ppo, task, 0, 3)
    assert (
        std.item() == pytest.approx(1.0) if within == 1.0 else std.item() > within
    )  # the bonus raises it to the ceiling
    std.data.fill_(beyond)
    ppo._head.project()
    assert std.tolist() == pytest.approx([within])


@pytest.mark.parametrize("device", [False, True])
def test_an_optimizer_keeps_the_flags_of_its_own_device(device: bool) -> None:
    """A step that is not capturable, as a CPU's, breaks the recording on a GPU that goes on from its checkpoint."""
    ppo, saved = make(desired_kl=0.02), make()
    for parameter in (*saved.actor.parameters(), *saved.critic.parameters()):
        parameter.grad = torch.ones_like(parameter)
    saved.optimizer.step()
    state = copy.deepcopy(saved.state_dict())
    state["optimizer"]["param_groups"][0]["capturable"] = not device
    ppo.optimizer.param_groups[0]["capturable"] = device
    ppo.load_state_dict(state)
    (group,) = ppo.optimizer.param_groups
    assert group["capturable"] is device and group["fused"] and group["lr"] is ppo._rate
    moments, existing = ppo.optimizer.state_dict()["state"], state["optimizer"]["state"]
    assert moments and all(torch.equal(moments[i]["exp_avg"], existing[i]["exp_avg"]) for i in existing)


def test_noise_and_minibatches_belong_to_worlds_not_to_ranks() -> None:
    def drawn(first: int, count: int, iteration: int) -> tuple[torch.Tensor, torch.Tensor]:
        ppo = make(count, first, 6, epochs=3)
        ppo.begin(iteration)
        actions = []
        for ppo.rollout.step in range(3):
            actions.append(ppo.act(groups(torch.zeros(count, 2))).clone())
        ppo._draws.order(ppo._orders, ppo._scratch)
        steps, worlds = ppo._orders // count, ppo._orders % count + first
        return torch.stack(actions), torch.stack((steps, worlds))

    (whole, order), (left, first), (right, second) = drawn(0, 6, 4), drawn(0, 2, 4), drawn(2, 4, 4)
    torch.testing.assert_close(whole, torch.cat((left, right), 1))  # the network's outputs differ by rounding
    assert torch.equal(order, torch.cat((first, second), 3))
    other, later = drawn(0, 6, 5)
    assert not torch.allclose(whole, other, atol=0.1) and not torch.equal(order, later)
    assert len(torch.unique(whole)) == whole.numel()


def test_noise_is_normal_and_independent() -> None:
    ppo = make(512, steps=32, minibatches=1)
    ppo.begin(0)
    drawn = []
    for ppo.rollout.step in range(32):
        mean = ppo.act(groups(torch.zeros(512, 2)))
        drawn.append((mean - ppo.rollout.outputs[ppo.rollout.step]).flatten().clone())
    noise = torch.stack(drawn)
    assert abs(float(noise.mean())) < 0.03 and float(noise.std()) == pytest.approx(1.0, abs=0.02)
    assert float((noise.abs() > 2.0).float().mean()) == pytest.approx(0.0455, abs=0.01)
    for one, two in ((noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1])):
        assert abs(float((one * two).mean())) < 0.03


def stock_twin(ppo: PPO, config: PointPPO, worlds: int) -> StockPPO:
    """rsl-rl's PPO with the same weights."""
    example = TensorDict({"policy": torch.zeros(worlds, 2)}, batch_size=[worlds])
    groups = {"actor": ["policy"], "critic": ["policy"]}
    common = dict(hidden_dims=config.hidden_sizes, activation=config.activation, obs_normalization=True)
    distribution = {"class_name": GaussianDistribution, "init_std": config.init_std}
    actor = MLPModel(example, groups, "actor", 1, distribution_cfg=distribution, **common)
    critic = MLPModel(example, groups, "critic", 1, **common)
    actor.load_state_dict(ppo.actor.state_dict())
    critic.load_state_dict(ppo.critic.state_dict())
    return StockPPO(
        actor,
        critic,
        RolloutStorage("rl", worlds, config.steps, example, [1]),
        num_learning_epochs=config.epochs,
        num_mini_batches=config.minibatches,
        entropy_coef=config.entropy_coef,
        learning_rate=config.learning_rate,
        desired_kl=config.desired_kl,
    )


@pytest.mark.parametrize("entropy_coef", [0.0, 0.01])
def test_an_update_is_that_of_rsl_rl(entropy_coef: float) -> None:
    """Three iterations, four passes each, over whole batches (so that the order of samples, which differs, plays no part)."""
    config = PointPPO(epochs=4, minibatches=1, entropy_coef=entropy_coef)
    worlds = 6
    ppo = make(worlds, epochs=4, minibatches=1, entropy_coef=entropy_coef)
    stock = stock_twin(ppo, config, worlds)
    task = Point(PointConfig(episode_seconds=1000.0), worlds)
    for iteration in range(3):
        ppo.begin(iteration)
        for _ in range(config.steps):
            seen = groups(task.observations)
            stock.act(TensorDict({"policy": task.observations.clone()}, batch_size=[worlds]))
            task.step(ppo.act(seen))
            ppo.record(transition_of(task))
            stock.transition.rewards, stock.transition.dones = task.rewards.clone(), task.dones.clone()
            stock.storage.add_transition(stock.transition)
            stock.transition.clear()
        stock.storage.actions.copy_(ppo.rollout.actions)
        # the actions are ours: rsl-rl's own draws would differ
        stock.actor.distribution.update(stock.storage.distribution_params[0])
        stock.storage.actions_log_prob[..., 0] = stock.actor.distribution.log_prob(stock.storage.actions).detach()
        stock.compute_returns(TensorDict({"policy": task.observations}, batch_size=[worlds]))
        losses = {name: float(value) for name, value in ppo.learn(groups(task.observations)).items()}
        torch.testing.assert_close(ppo.rollout.advantages, stock.storage.advantages[..., 0], rtol=1e-4, atol=1e-5)
        theirs = stock.update()
        assert losses["value_loss"] == pytest.approx(theirs["value"], rel=1e-4)
        assert losses["surrogate_loss"] == pytest.approx(theirs["surrogate"], rel=1e-3, abs=1e-6)
        assert losses["entropy"] == pytest.approx(theirs["entropy"], rel=1e-5)
        assert losses["learning_rate"] == pytest.approx(stock.learning_rate)
    for ours, other in ((ppo.actor, stock.actor), (ppo.critic, stock.critic)):
        for name, tensor in ours.state_dict().items():
            torch.testing.assert_close(tensor, other.state_dict()[name], rtol=1e-3, atol=1e-4, msg=name)
    assert stock.learning_rate != config.learning_rate, "the rule was never exercised"


def test_every_epoch_has_its_own_minibatches_with_each_sample_once_and_as_many_of_every_world() -> None:
    ppo = make(epochs=3, minibatches=2)
    ppo.begin(0)
    ppo._draws.order(ppo._orders, ppo._scratch)
    epochs = ppo._orders.view(3, 2, -1).clone()
    assert not torch.equal(epochs[0], epochs[1]) and not torch.equal(epochs[1], epochs[2])
    for epoch in epochs:
        assert torch.equal(epoch.flatten().sort().values, torch.arange(32))
        for minibatch in epoch:
            assert (minibatch % 4).bincount().tolist() == [4, 4, 4, 4]


def test_unsupported_settings_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"critic_observations: the task has no group 'critic'; it has policy"):
        PPO(
            PointPPO(critic_observations="critic"),
            LearningSetting(Spaces({"policy": (2,)}, 1), WorldShare(0, 4, 4), alone(), 1),
        )
    with pytest.raises(ValueError, match=r"'critic' is a group of images .*; rsl_rl can do that"):
        spaces = Spaces({"policy": (2,), "critic": (3, 8, 8)}, 1)
        PPO(PointPPO(critic_observations="critic"), LearningSetting(spaces, WorldShare(0, 4, 4), alone(), 1))
    with pytest.raises(ValueError, match=r"minibatches: 9 minibatches need as many steps of each world, there are 8"):
        PPOConfig(steps=8, minibatches=9)
    with pytest.raises(ValueError, match="adam has none; set optimizer: adamw"):
        PPOConfig(weight_decay=0.1)
