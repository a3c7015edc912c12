"""SAC against numbers worked out by hand, by loops, and by torch."""

from __future__ import annotations

import copy
import dataclasses
import io
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torch.utils._python_dispatch import TorchDispatchMode

from tests.support.worker.loop import alone, groups, iterate, setting_of, spaces_of
from tests.support.worker.point_task import Point, PointConfig
from worker.distributed import Gang, Placement
from worker.learning.algorithm import Algorithm, Policy, Setting, Share, Spaces, Transition
from worker.learning.sac import kernels
from worker.learning.sac.learner import LOSSES
from worker.learning.sac.networks import Actor, Critics
from worker.learning.sac.replay import Batch, Replay
from worker.learning.sac.sac import SAC
from worker.learning.sac.settings import SACConfig

torch.set_num_threads(1)

SMALL = SACConfig(
    steps=4,
    updates=4,
    batch_size=24,
    replay_steps=32,
    warm_up=4,
    actor_sizes=(16, 16),
    critic_sizes=(16, 12),
    atoms=11,
    v_min=-5.0,
    v_max=15.0,
    gamma=0.9,
    n_step=1,
)


def make(task: Any, seed: int = 1, gang: Gang | None = None, share: Share | None = None, **settings: Any) -> SAC:
    torch.manual_seed(5)
    return SAC(dataclasses.replace(SMALL, **settings), setting_of(task, seed, gang, share))


def point(worlds: int = 6, first: int = 0) -> Point:
    return Point(PointConfig(), worlds, seed=3, first_world=first)


def same(left: Any, right: Any) -> bool:
    """Whether two nested states hold the same values, bit for bit."""
    if isinstance(left, torch.Tensor):
        return torch.equal(left, right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(value, right[key]) for key, value in left.items())
    if isinstance(left, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(left == right)


# -- settings ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"steps": True}, "steps"),
        ({"gamma": True}, "gamma"),
        ({"gamma": 1.1}, "gamma"),
        ({"gamma": float("nan")}, "gamma"),
        ({"tau": 0.0}, "tau"),
        ({"batch_size": "64"}, "batch_size"),
        ({"batch_size": 64.0}, "batch_size"),
        ({"layer_norm": 1}, "layer_norm"),
        ({"actor_sizes": []}, "actor_sizes"),
        ({"actor_sizes": [True]}, "actor_sizes"),
        ({"combine": "max"}, "combine"),
        ({"updates": 3}, "updates: expected a multiple of policy_delay"),
        ({"replay_steps": 2}, "replay_steps: expected at least steps"),
        ({"n_step": 2000}, "replay_steps: expected at least steps"),
        ({"v_min": 20.0}, "v_min: expected less than v_max"),
        ({"rate": 1}, "rate"),
    ],
)
def test_settings_that_can_not_be_are_refused_by_name(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        SACConfig(**settings)


def test_settings_as_yaml_gives_them() -> None:
    config = SACConfig(actor_sizes=[64, 32], gamma=1)  # type: ignore[arg-type]
    assert config.actor_sizes == (64, 32) and isinstance(config.gamma, float)
    assert SACConfig(**dataclasses.asdict(config)) == config
    assert SACConfig(atoms=1, v_min=0.0, v_max=0.0).atoms == 1, "the range is not used with one atom"


def test_settings_are_read_without_torch() -> None:
    told = "import sys, worker.learning.sac.settings; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", told], cwd=Path(__file__).parents[3]).returncode == 0


@pytest.mark.parametrize(
    ("spaces", "settings", "message"),
    [
        (Spaces({"policy": (3, 8, 8)}, 1), {}, "it can't learn from images.*use ppo"),
        (Spaces({"policy": (3,)}, 4, discrete=True), {}, "this task's are choices; use ppo"),
        (
            Spaces({"policy": (3,)}, 1),
            {"critic_group": "critic"},
            "critic_group: there is no observation group 'critic'",
        ),
    ],
)
def test_what_it_can_not_do_is_refused(spaces: Spaces, settings: dict[str, Any], message: str) -> None:
    setting = Setting(spaces, Share(0, 2, 2), alone(), 0)
    with pytest.raises(ValueError, match=f"^sac.*{message}"):
        SAC(dataclasses.replace(SMALL, **settings), setting)


# -- exploring --------------------------------------------------------------------------------------------------------


def draw(first: int, worlds: int, key: int, uniform: bool = False, actions: int = 3) -> torch.Tensor:
    """What is explored around a mean of 0.2 with a deviation of 0.5."""
    drawn = torch.zeros(worlds, actions)
    mean, log_std = torch.full_like(drawn, 0.2), torch.full_like(drawn, 0.5).log()
    keys = torch.tensor([0, key], dtype=torch.int32)
    kernels.explore(keys, 1, first, torch.tensor([int(uniform)], dtype=torch.int32), 2.0, mean, log_std, drawn)
    return drawn


def test_noise_belongs_to_worlds_and_steps_not_to_ranks() -> None:
    whole = draw(0, 8, 7)
    assert torch.equal(whole, torch.cat((draw(0, 3, 7), draw(3, 5, 7))))
    assert len(torch.unique(whole)) == whole.numel()
    assert not torch.isclose(whole, draw(0, 8, 8)).any()


def test_exploring_is_normal_noise_squashed_or_uniform() -> None:
    noise = (torch.atanh(draw(0, 20_000, 7) / 2.0) - 0.2) / 0.5
    assert noise.mean().abs() < 0.02 and (noise.std() - 1.0).abs() < 0.02
    assert (noise[:, 0] * noise[:, 1]).mean().abs() < 0.02, "the components of an action are independent"
    even = draw(0, 20_000, 7, uniform=True)
    assert even.abs().max() < 2.0 and even.mean().abs() < 0.03 and (even.std() - 2.0 / 3.0**0.5).abs() < 0.02


def test_actions_of_an_iteration_do_not_depend_on_the_ranks() -> None:
    def actions(first: int, count: int) -> torch.Tensor:
        task, drawn = point(count, first), []
        sac = make(task, share=Share(first, count, 6), warm_up=0)
        for iteration in range(2):
            sac.begin(iteration)
            for _ in range(sac.steps):
                drawn.append(sac.act(groups(task)).clone())
                sac.record(Transition(groups(task), groups(task, True), task.rewards, task.dones, task.time_outs))
        return torch.stack(drawn)

    whole = actions(0, 6)
    torch.testing.assert_close(whole, torch.cat((actions(0, 2), actions(2, 4)), 1))
    assert len(torch.unique(whole)) == whole.numel(), "every step has its own noise"


def test_actions_are_random_until_the_first_update() -> None:
    task = point(400)
    sac = make(task, warm_up=6, init_std=0.1)
    drawn: list[torch.Tensor] = []
    for iteration in range(3):
        sac.begin(iteration)
        drawn.append(sac.act(groups(task)).clone())
        iterate(sac, task, iteration, iteration + 1)
    spread = [float(each.std()) for each in drawn]
    assert spread[0] > 0.5 and spread[1] > 0.5 and spread[2] < 0.2
    assert sac.state_dict()["updates"] == 8, "4 steps are too few for the first iteration, 8 are enough"


# -- replay -----------------------------------------------------------------------------------------------------------


def fill(replay: Replay, steps: int, ends: torch.Tensor | None = None, time_outs: torch.Tensor | None = None) -> None:
    """Write ``steps`` steps whose observations, actions and rewards say which step, counted from 0, and which world they are of."""
    slot = torch.zeros(1, dtype=torch.int64)
    for step in range(steps):
        replay.find_slots(slot)
        number = torch.arange(replay.worlds).float() + 100.0 * step
        ended = ends[step] if ends is not None else torch.zeros(replay.worlds, dtype=torch.bool)
        after = ~ended | (time_outs[step] if time_outs is not None else False)
        outcomes = torch.stack((number, (~ended).float(), after.float()), 1)
        replay.write(slot, torch.stack((number, -number), 1), number.unsqueeze(1) + 0.5, outcomes)
        replay.advance(1)


@pytest.mark.parametrize("n_step", [1, 3])
def test_only_what_is_there_is_drawn_and_all_of_it(n_step: int) -> None:
    worlds, capacity = 3, 7
    generator = torch.Generator().manual_seed(0)
    for recorded in range(1, 24):
        replay = Replay(capacity, worlds, 1, 1, n_step, 0.9, "cpu")
        fill(replay, recorded)
        rows = torch.zeros(4000, dtype=torch.int64)
        there = replay.draw(rows, generator)
        assert there == (recorded >= n_step)
        if there:
            begun = (replay.sample(rows).before[:, 0] / 100.0).floor()
            expected = torch.arange(max(0, recorded - capacity), recorded - n_step + 1)
            assert torch.equal(begun.unique(), expected.float())
            found = replay.sample(rows).before[:, 0].unique()
            assert len(found) == len(expected) * worlds


@pytest.mark.parametrize("n_step", [1, 2])
def test_what_an_iteration_draws_is_there_once_its_steps_are_written(n_step: int) -> None:
    """Rows are drawn before the steps that overwrite the oldest ones; each row is read after them."""
    task = point(3)
    sac = make(task, replay_steps=10, n_step=n_step, batch_size=400, warm_up=0)
    for iteration in range(8):
        sac.replay.before[..., 0] = float("nan")  # what is read must have been written since
        for each in range(iteration):
            kept = torch.arange(4 * each, 4 * each + 4)[-10:]
            sac.replay.before[kept % 10, :, 0] = kept.float().unsqueeze(1)
        sac.begin(iteration)
        for step in range(4):
            task.step(sac.act(groups(task)))
            sac.record(Transition(groups(task), groups(task, True), task.rewards, task.dones, task.time_outs))
            sac.replay.before[sac._slots[step], :, 0] = 4.0 * iteration + step
        written = 4 * iteration + 4
        begun = sac.replay.before[..., 0].flatten()[sac._all_rows]
        assert torch.equal(begun.unique(), torch.arange(max(0, written - 10), written - n_step + 1).float())
        sac.replay.advance(4)


def by_loop(world: int, first: int, n: int, gamma: float, ends: torch.Tensor, time_outs: torch.Tensor) -> list[float]:
    """Return, discount and last step of the transition that begins in step ``first``."""
    total, worth = 0.0, 1.0
    for step in range(first, first + n):
        total += worth * (100.0 * step + world)
        worth *= gamma
        if ends[step, world]:
            return [total, worth if time_outs[step, world] else 0.0, step]
    return [total, worth, first + n - 1]


@pytest.mark.parametrize("n_step", [1, 2, 5])
def test_returns_of_n_steps_against_a_loop(n_step: int) -> None:
    steps, worlds, capacity, gamma = 50, 4, 30, 0.9
    generator = torch.Generator().manual_seed(1)
    ends = torch.rand(steps, worlds, generator=generator) < 0.3
    time_outs = ends & (torch.rand(steps, worlds, generator=generator) < 0.5)
    replay = Replay(capacity, worlds, 1, 1, n_step, gamma, "cpu")
    fill(replay, steps, ends, time_outs)
    rows = torch.zeros(2000, dtype=torch.int64)
    assert replay.draw(rows, generator)
    batch = replay.sample(rows)
    for i in range(len(rows)):
        first, world = divmod(int(batch.before[i, 0]), 100)
        total, worth, last = by_loop(world, first, n_step, gamma, ends, time_outs)
        assert batch.returns[i].item() == pytest.approx(total, rel=1e-5)
        assert batch.discounts[i].item() == pytest.approx(worth)
        assert batch.after[i].item() == 100.0 * last + world + 0.5
        assert batch.before[i, 1] == -batch.before[i, 0]


def transition(observation: float, terminal: float, reward: float, done: bool, time_out: bool) -> Transition:
    """Of one world with one observation."""
    seen, ended = (TensorDict({"policy": torch.tensor([[x]])}, batch_size=[1]) for x in (observation, terminal))
    return Transition(seen, ended, torch.tensor([reward]), torch.tensor([done]), torch.tensor([time_out]))


def test_a_time_out_bootstraps_from_the_observation_before_the_reset_and_an_end_does_not() -> None:
    setting = Setting(Spaces({"policy": (1,)}, 1), Share(0, 1, 1), alone(), 0)
    sac = SAC(dataclasses.replace(SMALL, atoms=1, steps=3, warm_up=100, normalize_observations=False), setting)
    nan = float("nan")
    sac.begin(0)
    taken = []
    for observation, step in (
        (1.0, transition(2.0, nan, 10.0, False, False)),
        (2.0, transition(-1.0, 3.0, 20.0, True, True)),  # the clock ended it in 3, and a new episode begins in −1
        (-1.0, transition(-2.0, -3.0, 30.0, True, False)),  # it fell
    ):
        taken.append(sac.act(TensorDict({"policy": torch.tensor([[observation]])}, batch_size=[1])).clone())
        sac.record(step)
    batch = sac.replay.sample(torch.arange(3))
    assert batch.before[:, 0].tolist() == [1.0, 2.0, -1.0]
    assert torch.equal(batch.before[:, 1:], torch.cat(taken))
    assert batch.after.flatten().tolist() == [2.0, 3.0, -3.0]
    # target critics that say 100 times what they see, and 7 for the entropy; γ = 0.9
    target = sac.learner.target(100.0 * batch.after.expand(2, -1, -1), batch, torch.full((3,), 7.0))
    assert target.flatten().tolist() == pytest.approx([10 + 0.9 * 207, 20 + 0.9 * 307, 30.0])


# -- critics ----------------------------------------------------------------------------------------------------------


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
    found = kernels.project(
        probabilities, returns, discounts, bonuses, least, greatest, torch.full((samples, atoms), float("nan"))
    )
    numbers = zip(probabilities, returns.tolist(), discounts.tolist(), bonuses.tolist(), strict=True)
    expected = torch.tensor([projection_by_loop(*each, least, greatest) for each in numbers])
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(found.sum(1), torch.ones(samples), atol=1e-5, rtol=0)


def test_projection_keeps_the_mean_and_passes_on_what_is_not_finite() -> None:
    torch.manual_seed(0)
    values = torch.linspace(-10.0, 10.0, 41)
    probabilities = torch.zeros(2, 41)
    probabilities[:, 15:26] = torch.rand(2, 11).softmax(1)
    numbers = torch.tensor([1.3, float("nan")]), torch.tensor([0.9, 0.9]), torch.tensor([0.4, 0.4])
    found = kernels.project(probabilities, *numbers, -10.0, 10.0, torch.zeros(2, 41))
    assert float(found[0] @ values) == pytest.approx(1.3 + 0.9 * (float(probabilities[0] @ values) + 0.4), abs=1e-4)
    assert found[1].isnan().all()


@pytest.mark.parametrize("combine", ["mean", "min"])
def test_how_critics_are_combined(combine: Any) -> None:
    config = SACConfig(atoms=3, v_min=0.0, v_max=2.0, critics=2, combine=combine, critic_sizes=(4,))
    critics = Critics(config, 2, 1)
    given = torch.tensor(
        [[[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]], [[0.25, 0.25, 0.5], [0.0, 0.5, 0.5]]]
    )  # means ¾ 2, 1¼ 1½
    outputs = given.clamp(min=1e-30).log()
    together = {"mean": [1.0, 1.75], "min": [0.75, 1.5]}[combine]
    torch.testing.assert_close(critics.combined_mean(outputs), torch.tensor(together))
    chosen = {"mean": given.mean(0), "min": torch.stack((given[0, 0], given[1, 1]))}[combine]
    torch.testing.assert_close(critics.combined_distribution(outputs), chosen)
    single = Critics(dataclasses.replace(config, atoms=1), 2, 1)
    mean = single.combined_mean(torch.tensor([[[1.0], [4.0]], [[3.0], [2.0]]]))
    assert mean.tolist() == ([2.0, 3.0] if combine == "mean" else [1.0, 2.0])


@pytest.mark.parametrize("layer_norm", [True, False])
def test_several_critics_are_each_a_network_of_its_own(layer_norm: bool) -> None:
    torch.manual_seed(0)
    critics = Critics(dataclasses.replace(SMALL, critics=3, layer_norm=layer_norm), 4, 2)
    with torch.no_grad():
        for each in (*critics.gains, *critics.offsets):
            each.normal_()
    observations, actions = torch.randn(7, 4), torch.randn(7, 2)
    outputs = critics(observations, actions)
    assert outputs.shape == (3, 7, 11)
    for number in range(3):
        x = torch.cat((observations, actions), 1)
        for layer in range(3):
            x = x @ critics.weights[layer][number] + critics.biases[layer][number]
            if layer < 2:
                if layer_norm:
                    x = torch.nn.functional.layer_norm(x, x.shape[1:])
                    x = x * critics.gains[layer][number] + critics.offsets[layer][number]
                x = x * x.sigmoid()
        torch.testing.assert_close(outputs[number], x)


# -- policy -----------------------------------------------------------------------------------------------------------


def test_log_probabilities_are_those_of_torch() -> None:
    torch.manual_seed(0)
    actor = Actor(dataclasses.replace(SMALL, action_limit=2.0), 3, 2)
    with torch.no_grad():
        actor.head.weight.normal_()
    observations, noise = torch.randn(50, 3), torch.randn(50, 2)
    actions, log_prob = actor.sample(observations, noise)
    mean, log_std = actor.spread(observations)
    squashed = TransformedDistribution(Normal(mean.double(), log_std.double().exp()), [TanhTransform()])
    inner = torch.tanh(mean.double() + log_std.double().exp() * noise.double())
    torch.testing.assert_close(actions.double(), 2.0 * inner, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(log_prob.double(), squashed.log_prob(inner).sum(1), atol=1e-3, rtol=1e-3)


def test_the_first_policy_is_centred_and_as_wide_as_it_is_told() -> None:
    actor = Actor(dataclasses.replace(SMALL, init_std=0.3), 3, 2)
    mean, log_std = actor(torch.randn(50, 3))
    assert mean.abs().max() < 0.05
    torch.testing.assert_close(log_std.exp(), torch.full((50, 2), 0.3), atol=0.02, rtol=0)


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
        rows = zip(
            after.softmax(-1).mean(0).detach(),
            batch.returns.tolist(),
            batch.discounts.tolist(),
            (-0.3 * log_prob).tolist(),
            strict=True,
        )
        target = torch.tensor([projection_by_loop(*row, -5.0, 15.0) for row in rows])
        critic_loss = sum(torch.nn.functional.cross_entropy(each, target) for each in outputs)
    expected = torch.autograd.grad(critic_loss, [*critics.parameters()])
    torch.testing.assert_close(found[0], [*expected], atol=1e-5, rtol=1e-3)

    chosen, log_prob = actor.sample(batch.before[:, :2], noise[1])
    value = critics.mean(critics(batch.before[:, :2], chosen)).mean(0)
    policy_loss = (0.3 * log_prob - value).mean()
    torch.testing.assert_close(
        found[1], [*torch.autograd.grad(policy_loss, [*actor.parameters()])], atol=1e-5, rtol=1e-3
    )
    torch.testing.assert_close(temperature_gradient, (0.3 * (-log_prob + 0.5)).mean().detach())
    q_mean = critics.mean(outputs).mean()
    torch.testing.assert_close(losses, torch.stack((policy_loss, -log_prob.mean(), critic_loss, q_mean)).detach())


@pytest.mark.parametrize(("target", "rises"), [(0.6, True), (-3.0, False)])
def test_the_temperature_rises_where_the_entropy_is_too_low_and_falls_where_it_is_too_high(
    target: float, rises: bool
) -> None:
    sac = make(point(), init_std=0.3, init_temperature=0.1, target_entropy=target, temperature_learning_rate=0.01)
    before = float(sac.learner.temperature)
    sac.learner.compute(batch_of(sac, 24), torch.randn(2, 24, 1), True)
    assert -3.0 < float(sac.learner.losses[LOSSES.index("entropy")]) < 0.6
    sac.learner.apply(True)
    assert (float(sac.learner.temperature) > before) is rises


def test_only_critics_learn_between_the_updates_of_the_policy() -> None:
    sac = make(point(), tau=0.25)
    learner = sac.learner
    policy, critics, targets = (
        copy.deepcopy(each.state_dict()) for each in (learner.actor, learner.critics, learner.targets)
    )
    learner.compute(batch_of(sac, 24), torch.randn(2, 24, 1), False)
    learner.apply(False)
    assert same(policy, learner.actor.state_dict())
    assert learner.losses[:2].tolist() == [0.0, 0.0] and float(learner.temperature) == pytest.approx(
        SMALL.init_temperature
    )
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


def test_critics_may_know_what_the_policy_does_not_see() -> None:
    setting = Setting(Spaces({"policy": (2,), "critic": (3,)}, 1), Share(0, 4, 4), alone(), 0)
    sac = SAC(dataclasses.replace(SMALL, critic_group="critic", warm_up=0), setting)
    assert sac.learner.critics.weights[0].shape == (2, 4, 16) and sac.learner.actor.body[0].in_features == 2
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


# -- the whole --------------------------------------------------------------------------------------------------------


def test_it_is_an_algorithm() -> None:
    algorithm: Algorithm = make(point())
    policy: Policy = algorithm.policy()
    assert algorithm.captures_rollout and algorithm.steps == 4 and policy.act(groups(point())).shape == (6, 1)
    names = {"actor_loss", "entropy", "critic_loss", "q_mean", "temperature", "learning_rate"}
    task = point()
    for iteration in range(3):
        metrics = iterate(algorithm, task, iteration, iteration + 1)
        assert metrics.keys() == names and all(value.shape == () and value.isfinite() for value in metrics.values())


@pytest.mark.parametrize("before", [1, 5, 9])
def test_a_resumed_run_ends_with_the_same_bits(before: int) -> None:
    """Saved while the ring fills, and after it has gone round."""
    task = point()
    whole = make(task, n_step=2, replay_steps=22)
    iterate(whole, task, 0, before)
    saved = copy.deepcopy((whole.state_dict(), whole.world_state(), task.state_dict()))
    metrics = iterate(whole, task, before, before + 4)

    other_task = point()
    torch.manual_seed(99)
    resumed = SAC(whole.config, setting_of(other_task, seed=1))
    buffer = io.BytesIO()
    torch.save(saved, buffer)
    buffer.seek(0)
    learner, worlds, states = torch.load(buffer, weights_only=True)
    resumed.load_state_dict(learner)
    resumed.load_world_state(worlds)
    other_task.load_state_dict(states)
    again = iterate(resumed, other_task, before, before + 4)
    assert same(dict(metrics), dict(again))
    assert same(whole.state_dict(), resumed.state_dict()) and same(
        dict(whole.world_state()), dict(resumed.world_state())
    )
    assert all(tensor.shape[0] == 6 for tensor in whole.world_state().values())


def test_without_its_replay_a_resumed_run_fills_a_new_one_with_the_policy() -> None:
    task = point(400)
    sac = make(task, save_replay=False, warm_up=8, init_std=0.1, replay_steps=16)
    iterate(sac, task, 0, 3)
    assert sac.world_state() == {}
    resumed = make(task, save_replay=False, warm_up=8, init_std=0.1, replay_steps=16)
    resumed.load_state_dict(sac.state_dict())
    resumed.load_world_state(sac.world_state())
    resumed.begin(3)
    assert resumed.act(groups(task)).std() < 0.3, "it has learnt: no uniform actions"
    learnt = copy.deepcopy(resumed.learner.critics.state_dict())
    iterate(resumed, task, 3, 4)
    assert same(learnt, resumed.learner.critics.state_dict()), "4 steps are too few"
    iterate(resumed, task, 4, 5)
    assert not same(learnt, resumed.learner.critics.state_dict())


def test_weights_alone_are_taken_over_with_fresh_optimizers() -> None:
    task = point()
    sac = make(task)
    iterate(sac, task, 0, 4)
    fresh = make(task, critic_learning_rate=0.123)
    fresh.load_state_dict(sac.state_dict(), weights_only=True)
    mine, theirs = fresh.state_dict(), sac.state_dict()
    for part in ("policy", "critics", "targets", "updates"):
        assert same(mine[part], theirs[part])
    assert float(fresh.learner.temperature) == pytest.approx(fresh.config.init_temperature), "it is worth in rewards"
    assert float(sac.learner.temperature) != pytest.approx(fresh.config.init_temperature)
    assert not mine["critic_optimizer"]["state"] and theirs["critic_optimizer"]["state"]
    full = make(task, critic_learning_rate=0.123)
    full.load_state_dict(sac.state_dict())
    group = full.learner._critic_optimizer.param_groups[0]
    assert group["lr"] == 0.123, "the job's learning rate, not the checkpoint's"
    with pytest.raises(RuntimeError):
        make(task, critic_sizes=(8,)).load_state_dict(sac.state_dict())
    with pytest.raises(ValueError, match=r"replay_steps"):
        make(task, replay_steps=40).load_world_state(sac.world_state())


def test_a_policy_alone_acts_as_the_algorithm_does() -> None:
    task = point()
    sac = make(task)
    iterate(sac, task, 0, 5)
    policy = SAC.build_policy(sac.config, spaces_of(task), "cpu")
    policy.load_state_dict(copy.deepcopy(sac.state_dict()["policy"]))
    policy.reset()
    observations = groups(task)
    expected = sac.policy().act(observations)
    assert torch.equal(policy.act(observations), expected)
    actor = sac.learner.actor
    normal = (observations["policy"] - actor.normalizer.mean) / (actor.normalizer.std + actor.normalizer.eps)
    torch.testing.assert_close(expected, torch.tanh(actor.spread(normal)[0]).detach())
    assert actor.normalizer.std.sub(1.0).abs().max() > 0.05, "the normaliser was never exercised"


def test_the_exported_policy_computes_the_same() -> None:
    import onnx
    from onnx.reference import ReferenceEvaluator

    task = point()
    sac = make(task, action_limit=0.8)
    iterate(sac, task, 0, 5)
    exported = sac.policy().module()
    assert list(exported.inputs) == ["obs"] and list(exported.outputs) == ["actions"]
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            exported.network,
            tuple(exported.inputs.values()),
            buffer,
            dynamo=False,
            opset_version=18,
            input_names=list(exported.inputs),
            output_names=list(exported.outputs),
            dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}},
        )
    model = ReferenceEvaluator(onnx.load_from_string(buffer.getvalue()))
    (found,) = model.run(None, {"obs": exported.sample["policy"].numpy()})
    torch.testing.assert_close(torch.from_numpy(found), sac.policy().act(exported.sample), atol=1e-5, rtol=0)
    moved = exported.sample["policy"].mean(0) - sac.learner.actor.normalizer.mean
    assert (moved.abs() < 0.5).all(), "the sample is of what the policy has met"


def test_a_reward_that_is_not_finite_shows_in_the_losses() -> None:
    task = Point(PointConfig(poison_at=6), 6, seed=3)
    sac = make(task, batch_size=200)
    assert iterate(sac, task, 0, 1)["critic_loss"].isfinite()
    assert iterate(sac, task, 1, 2)["critic_loss"].isnan()


class Watch(TorchDispatchMode):
    """Notes every operation that no graph can hold: those that ask the device for a value or draw from torch's generators."""

    REFUSED = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "lift_fresh", "rand", "normal", "bernoulli")

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if any(part in name for part in self.REFUSED):
            self.found.append(name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("settings", [{"n_step": 3, "max_grad_norm": 1.0}, {"atoms": 1, "combine": "min"}])
def test_what_is_recorded_asks_the_device_for_nothing_and_draws_nothing(settings: dict[str, Any]) -> None:
    task = point()
    sac = make(task, **settings)
    iterate(sac, task, 0, 3)
    sac.begin(3)
    task_step = Transition(groups(task), groups(task, True), task.rewards, task.dones, task.time_outs)
    with Watch() as watch:
        for _ in range(sac.steps):
            sac.act(task_step.observations)
            sac.record(task_step)
        for graph in sac.graphs:
            graph()
    assert watch.found == []


class Half(Gang):
    """One of two ranks in this process: what it would share is kept until both are there."""

    def __init__(self, rank: int) -> None:
        super().__init__(Placement(rank=rank, world_size=2), "cpu", None, ["here", "there"])

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor

    def broadcast(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor


def test_two_ranks_take_the_step_that_one_takes_with_the_same_samples() -> None:
    """Moments of observations, gradients and losses of two ranks add up to those of one that has their worlds and their samples."""
    one_task, tasks = point(6), [point(2), point(4, first=2)]
    settings = {"batch_size": 25, "n_step": 2}
    one = make(one_task, **settings)
    ranks = [
        make(task, gang=Half(rank), share=share, **settings)
        for rank, (task, share) in enumerate(zip(tasks, (Share(0, 2, 6), Share(2, 4, 6)), strict=True))
    ]
    assert [sac.learner.samples for sac in ranks] == [12, 13]
    for sac, task in ((one, one_task), *zip(ranks, tasks, strict=True)):
        sac.begin(0)
        for _ in range(sac.steps):
            task.step(sac.act(groups(task)))
            sac.record(Transition(groups(task), groups(task, True), task.rewards, task.dones, task.time_outs))
        sac.replay.advance(sac.steps)
        sac._gather_moments()
    assert torch.equal(one.replay.after, torch.cat([sac.replay.after for sac in ranks], 1)), "the same worlds"
    torch.testing.assert_close(one._moment_sums, ranks[0]._moment_sums + ranks[1]._moment_sums)
    for sac in (one, *ranks):
        sac._moment_sums.copy_(one._moment_sums)
        sac._merge_moments()

    noise = torch.randn(2, 25, 1)
    rows = [sac._all_rows[0] for sac in ranks]
    of_one = [rows // count * 6 + rows % count + first for rows, count, first in zip(rows, (2, 4), (0, 2), strict=True)]
    one.learner.compute(one.replay.sample(torch.cat(of_one)), noise, True)
    for sac, part, its in zip(ranks, (noise[:, :12], noise[:, 12:]), rows, strict=True):
        sac.learner.compute(sac.replay.sample(its), part, True)
    together = ranks[0].learner.shared(True) + ranks[1].learner.shared(True)
    torch.testing.assert_close(one.learner.shared(True), together, atol=1e-6, rtol=1e-4)
    with pytest.raises(ValueError, match=r"sac.batch_size: 2 ranks need at least as many samples, got 1"):
        make(tasks[0], gang=Half(0), share=Share(0, 2, 6), batch_size=1)
