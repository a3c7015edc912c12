"""The rollout buffer: the data of one iteration of all worlds, in buffers with fixed addresses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models.mlp_model import MLPModel
from tensordict import TensorDict
from torch import nn

from worker.learning.algorithm import Transition
from worker.learning.ppo import linear_layers as linear
from worker.learning.ppo.networks import PixelModel


class GroupRollout:
    """One observation group over a rollout, as one network sees it.

    Attributes:
        observations: Shape (steps, worlds, *shape), float32, or uint8 of images.
        latents: Input of the network's last part: normalised observations, or features; shape (steps, worlds, features).
        padded: The same, padded with columns of zeros, see :func:`worker.learning.ppo.linear_layers.padded`.
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
        """Record the observations before a step; returns their latents, shape (worlds, features)."""
        seen = self.observations[step].copy_(observations[self.group])
        return self.latents[step].copy_(self.latent(seen))

    def latent(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (…, features) for observations of shape (…, *shape)."""
        groups: Any = {self.group: observations}  # rsl-rl only looks its groups up
        return self.model.get_latent(groups)

    def batch(self, rows: torch.Tensor) -> torch.Tensor:
        """Padded latents of the samples ``rows`` of the flattened rollout; for images, with gradients of the convolutions."""
        if self.is_image:
            return self.latent(self.observations.flatten(0, 1)[rows])
        return self.padded.flatten(0, 1)[rows]


class RolloutBuffer:
    """The record of an iteration; each part has shape (steps, worlds) and its own last dimension.

    Attributes:
        outputs: Outputs of the actor's network: means, or logits.
        actions: The actions taken.
        rewards, values, returns, advantages, log_prob: Float32.
        going_on: 1 where the episode went on after the step, 0 where it ended.
        time_outs: 1 where it ended by the clock alone.
        terminal: Observations of the critic's group before the reset, valid where an episode ended; None for images.
    """

    def __init__(self, actor: GroupRollout, critic: GroupRollout, outputs: int, actions: int) -> None:
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
        """Record the result of a step, and advance to the next."""
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

    def add_future(self, gamma: float, critic_mlp: nn.Module) -> None:
        """Where the clock cut an episode, its future is the value of the observation at the cut.

        Images are not rendered after the step, so the value of the previous image replaces it, as in rsl-rl. ``critic_mlp`` maps
        latents to values, shape (…, 1).
        """
        if self.terminal is None:
            self.rewards.addcmul_(self.time_outs, self.values, value=gamma)
            return
        critic, rewards = self.critic, self.rewards
        if rewards.device.type == "cpu":  # may look, and seldom finds many
            rows = self.time_outs.flatten().nonzero().squeeze(1)
            if len(rows):
                values = critic_mlp(critic.latent(self.terminal.flatten(0, 1)[rows])).squeeze(1)
                rewards.view(-1).index_add_(0, rows, values, alpha=gamma)
            return
        values = critic_mlp(critic.latent(self.terminal)).squeeze(-1)
        # the other rows may hold anything, NaN too
        rewards.add_(torch.where(self.time_outs > 0, values, torch.zeros_like(values)), alpha=gamma)
