"""PPO for tasks with choices and with images: draws, gradients and networks against torch's own."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.distributions import Categorical

from tests.support.worker.loop import alone
from tests.support.worker.point_task import PointPPO
from worker.learning.algorithm import LearningSetting, Spaces, WorldShare
from worker.learning.ppo.draws import Draws
from worker.learning.ppo.fused import PPO
from worker.learning.ppo.heads import Samples, clipped_loss
from worker.learning.ppo.networks import build_actor
from worker.settings.ppo import PPOConfig

SMALL: dict[str, Any] = {"channels": (4, 6), "kernel_sizes": (3, 2), "strides": (2, 1), "hidden_sizes": (8,)}
IMAGES = Spaces({"policy": (3, 7, 9)}, 2)


def learner(**settings: Any) -> PPO:
    torch.manual_seed(2)
    spaces = Spaces({"policy": (2,)}, 3, discrete=True)
    return PPO(PointPPO(steps=4, minibatches=2, **settings), LearningSetting(spaces, WorldShare(0, 5, 5), alone(), 1))


def drawn(first: int, worlds: int, step: int, logits: torch.Tensor, iteration: int = 1) -> torch.Tensor:
    draws = Draws(7, first, "cpu")
    draws.begin(iteration)
    return draws.choices(step, logits.expand(worlds, -1).contiguous(), torch.full((worlds, 1), -1.0)).clone()


def test_choices_are_drawn_by_their_probabilities_and_belong_to_worlds_and_steps() -> None:
    probabilities = torch.tensor([0.55, 0.05, 0.3, 0.1])
    found = drawn(0, 20_000, 3, probabilities.log())
    shares = torch.bincount(found[:, 0].long(), minlength=4) / 20_000
    # three standard deviations of the greatest share: 3 · √(0.55 · 0.45 / 20,000) = 0.011
    torch.testing.assert_close(shares, probabilities, atol=0.011, rtol=0.0)
    assert torch.equal(found[12_000:], drawn(12_000, 8_000, 3, probabilities.log()))
    for other in (drawn(0, 20_000, 4, probabilities.log()), drawn(0, 20_000, 3, probabilities.log(), iteration=2)):
        same = float((found == other).float().mean())
        assert same == pytest.approx(float(probabilities.square().sum()), abs=0.02), "it depends on the other"


def test_the_gradient_of_choices_is_that_of_torch_by_the_rows_of_the_minibatch() -> None:
    ppo = learner()
    torch.manual_seed(3)
    rollout, head = ppo.rollout, ppo._head
    rollout.outputs.normal_()
    rollout.actions.copy_(torch.randint(0, 3, rollout.actions.shape))
    for each in (rollout.advantages, rollout.returns, rollout.values):
        each.normal_()
    expected = Categorical(logits=rollout.outputs).log_prob(rollout.actions[..., 0])
    torch.testing.assert_close(head.log_prob(rollout), expected)
    rollout.log_prob.copy_(expected)
    rows = torch.tensor([1, 7, 12, 19, 4])
    outputs, values = torch.randn(5, 3, requires_grad=True), torch.randn(5, 1, requires_grad=True)
    losses = head.backward(rows, rollout, outputs, values)
    copies = [each.detach().clone().requires_grad_() for each in (outputs, values)]
    policy, old = Categorical(logits=copies[0]), Categorical(logits=rollout.outputs.flatten(0, 1)[rows])
    samples = [each.flatten()[rows] for each in (expected, rollout.advantages, rollout.returns, rollout.values)]
    terms = (
        policy.log_prob(rollout.actions.flatten()[rows]),
        policy.entropy(),
        torch.distributions.kl_divergence(old, policy),
    )
    loss, means = clipped_loss(ppo.config, Samples(*samples), *terms, copies[1][:, 0])
    loss.backward()
    torch.testing.assert_close(losses, means)
    for mine, its in zip((outputs, values), copies, strict=True):
        torch.testing.assert_close(mine.grad, its.grad)


def test_where_the_clock_cut_an_episode_of_images_its_future_is_the_value_of_the_image_before() -> None:
    config = PPOConfig(steps=2, minibatches=1, **SMALL)
    ppo = PPO(config, LearningSetting(IMAGES, WorldShare(0, 2, 2), alone(), 1))
    ppo.rollout.rewards.fill_(1.0)
    ppo.rollout.values.copy_(torch.tensor([[5.0, 6.0], [7.0, 8.0]]))
    ppo.rollout.time_outs.copy_(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
    ppo.rollout.add_future(0.5, ppo.critic.mlp)
    assert ppo.rollout.rewards.tolist() == [[1.0, 4.0], [4.5, 1.0]]


@pytest.mark.parametrize(
    ("shape", "change", "problem"),
    [
        ((3, 7, 9), {"kernel_sizes": (7, 1)}, None),  # 1 x 2 px are left for the second
        ((3, 7, 9), {"kernel_sizes": (8, 1)}, "kernel of 8 and a stride of 2, but 9 x 7 px are left"),
        ((3, 9, 7), {"kernel_sizes": (8, 1)}, "kernel of 8 and a stride of 2, but 7 x 9 px are left"),
        ((3, 7, 9), {"kernel_sizes": (3, 4)}, "convolution 2 has a kernel of 4 and a stride of 1"),
    ],
)
def test_convolutions_that_leave_nothing_of_the_image_are_refused(
    shape: tuple[int, ...], change: dict[str, Any], problem: str | None
) -> None:
    config, spaces = PPOConfig(**{**SMALL, **change}), Spaces({"policy": shape}, 2)
    if problem is None:
        build_actor(config, spaces)
    else:
        with pytest.raises(ValueError, match=problem):
            build_actor(config, spaces)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"channels": (4,)}, "one number of each for every convolution"),
        ({"kernel_sizes": (4,)}, "one number of each for every convolution"),
        ({"strides": (4,)}, "one number of each for every convolution"),
        ({"learning_rate_limits": (2e-3, 1e-3)}, "expected the least, then the greatest"),
    ],
)
def test_settings_that_do_not_agree_are_refused(settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        PPOConfig(**settings)
    assert PPOConfig(steps=4, minibatches=4, learning_rate_limits=(1e-3, 1e-3), optimizer="adamw")
