"""What one iteration of all worlds leaves behind, in buffers that stay where they are."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import nn

from worker.learning.algorithm import Transition
from worker.learning.ppo import linear
from worker.learning.ppo.models import MLPModel, PixelModel


class View:
    """One observation group over a rollout, as one network sees it.

    Attributes:
        observations: Shape (steps, worlds, *shape), float32, or uint8 of images.
        latents: What the network's last part reads: normalised observations, or features; shape (steps, worlds, features).
        padded: The same with columns of zeros behind them, see :func:`worker.learning.ppo.linear.padded`.
        last: The observation after the last step, shape (worlds, *shape).
    """

    def __init__(
        self, model: MLPModel | PixelModel, group: str, shape: Sequence[int], steps: int, worlds: int, device: str
    ) -> None:
        self.model, self.group, self.is_image = model, group, len(shape) > 1
        dtype = torch.uint8 if self.is_image else torch.float32
        self.observations = torch.zeros(steps, worlds, *shape, device=device, dtype=dtype)
        features = model._get_latent_dim()
        self.padded = torch.zeros(steps, worlds, linear.padded(features, device), device=device)
        self.latents = self.padded[..., :features]
        self.last = torch.zeros(worlds, *shape, device=device, dtype=dtype)

    def see(self, step: int, observations: TensorDict) -> torch.Tensor:
        """Note the observations before a step; their latents, shape (worlds, features)."""
        seen = self.observations[step].copy_(observations[self.group])
        return self.latents[step].copy_(self.latent(seen))

    def latent(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (…, features) for observations of shape (…, *shape)."""
        return self.model.get_latent({self.group: observations})

    def batch(self, rows: torch.Tensor) -> torch.Tensor:
        """Padded latents of the samples ``rows`` of the flattened rollout; of images with the gradient of what makes them."""
        if self.is_image:
            return self.latent(self.observations.flatten(0, 1)[rows])
        return self.padded.flatten(0, 1)[rows]


class Rollout:
    """What happened in an iteration, each of shape (steps, worlds) with a last dimension of its own.

    Attributes:
        outputs: Of the actor's network: means, or logits.
        actions: What was done.
        rewards, values, returns, advantages, log_prob: Float32.
        going_on: 1 where the episode went on after the step, 0 where it ended.
        time_outs: 1 where it ended by the clock alone.
        terminal: Observations of the critic's group before the reset, valid where an episode ended; None where there are none.
    """

    def __init__(self, actor: View, critic: View, outputs: int, actions: int) -> None:
        self.actor, self.critic = actor, critic
        self.views = [actor] if critic is actor else [actor, critic]
        steps, worlds = actor.latents.shape[:2]
        self.steps, self.worlds, self.step = steps, worlds, 0

        def empty(*shape: int) -> torch.Tensor:
            return torch.zeros(steps, worlds, *shape, device=actor.latents.device)

        self.outputs, self.actions = empty(outputs), empty(actions)
        self.rewards, self.values, self.returns, self.advantages, self.log_prob = (empty() for _ in range(5))
        self.going_on, self.time_outs = empty(), empty()
        self.terminal = None if critic.is_image else empty(*critic.observations.shape[2:])

    def record(self, step: Transition) -> None:
        """Note what a step did, and go on to the next."""
        at = self.step
        if self.terminal is not None:
            self.terminal[at].copy_(step.terminal_observations[self.critic.group])
        self.rewards[at].copy_(step.rewards)
        torch.logical_not(step.dones, out=self.going_on[at])
        self.time_outs[at].copy_(step.time_outs)
        self.step += 1

    def estimate_advantages(self, last: torch.Tensor, gamma: float, lam: float) -> None:
        """Generalised advantage estimation (Schulman et al. 2015, arXiv:1506.02438, eq. 16), and returns.

        Args:
            last: Values of the observations after the last step, shape (worlds,).
        """
        next_values = torch.cat((self.values[1:], last.unsqueeze(0)))
        delta = self.rewards + gamma * self.going_on * next_values - self.values
        decay = self.going_on * (gamma * lam)
        self.advantages[-1].copy_(delta[-1])
        for step in range(self.steps - 2, -1, -1):
            torch.addcmul(delta[step], decay[step], self.advantages[step + 1], out=self.advantages[step])
        torch.add(self.advantages, self.values, out=self.returns)

    def add_future(self, gamma: float, judge: nn.Module) -> None:
        """Where an episode was cut by the clock, its future is the value of the observation at which it was cut.

        Of images there is none after the step: the value of the one before stands for it, as in rsl-rl. ``judge`` makes values of
        latents, shape (…, 1).
        """
        if self.terminal is None:
            self.rewards.addcmul_(self.time_outs, self.values, value=gamma)
            return
        critic, rewards = self.critic, self.rewards
        if rewards.device.type == "cpu":  # may look, and seldom finds many
            rows = self.time_outs.flatten().nonzero().squeeze(1)
            if len(rows):
                values = judge(critic.latent(self.terminal.flatten(0, 1)[rows])).squeeze(1)
                rewards.view(-1).index_add_(0, rows, values, alpha=gamma)
            return
        values = judge(critic.latent(self.terminal)).squeeze(-1)
        # the other rows may hold anything, NaN too
        rewards.add_(torch.where(self.time_outs > 0, values, torch.zeros_like(values)), alpha=gamma)
