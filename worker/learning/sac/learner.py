"""The learner of SAC: its networks, and one update of them: targets, losses, gradients, steps."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.nn.functional import log_softmax

from worker.learning.algorithm import WorldShare
from worker.learning.distributed import Gang
from worker.learning.parts import keep_gradients, load_optimizer
from worker.learning.sac import kernels
from worker.learning.sac.networks import Critics, SquashedGaussianActor, make_normalizer
from worker.learning.sac.replay_buffer import Batch
from worker.settings.sac import SACConfig

BETAS = (0.9, 0.95)
"""Decays of AdamW's moments: shorter than usual, since the targets move (arXiv:2512.01996)."""
LOSSES = ("actor_loss", "entropy", "critic_loss", "q_mean")
"""Metrics of an update; the first two only if the policy learns."""


class Learner:
    """Policy, critics, target critics and temperature, with all buffers of learning at fixed addresses.

    An update is :meth:`compute`, the sum of its results over the ranks, and :meth:`apply`. All gradients are taken at the same weights
    and are in one flat buffer, with the parameters' gradients as views: the policy's, the temperature's, :data:`LOSSES`, the critics'. An
    update of only the critics sums the end of the buffer.

    Args:
        config: Hyperparameters.
        sizes: Length of one observation of the policy's group and, if different, of the critics' group.
        actions: Length of an action.
        gang: The ranks that learn together. All ranks take the main rank's weights.
    """

    def __init__(self, config: SACConfig, sizes: Sequence[int], actions: int, gang: Gang) -> None:
        self.config, self._actions, device = config, actions, gang.device
        self.actor = SquashedGaussianActor(config, sizes[0], actions).to(device)
        self.critics = Critics(config, sizes[-1], actions).to(device)
        for parameter in (*self.actor.parameters(), *self.critics.parameters()):
            gang.broadcast(parameter.data)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        own = [make_normalizer(config, size).to(device) for size in sizes[1:]]
        self.normalizers = [self.actor.normalizer, *own]
        """Of each group."""
        ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
        self.columns = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        """Columns of the groups in a row of all observations."""
        self.width = ends[-1]
        self.log_temperature = nn.Parameter(torch.tensor(config.init_temperature, device=device).log())
        self.samples = WorldShare.of(gang.rank, gang.size, config.batch_size).count
        """This rank's share of a batch."""
        self._projected = torch.zeros(self.samples, config.atoms, device=device)
        self.mass = torch.zeros((), device=device)
        """This rank's sum, over the updates since it was set to 0, of the targets' mean probability of ``v_max``."""
        self.norm = torch.zeros((), device=device)
        """Sum of the norms of the critics' gradients, before they are clipped, over the same updates."""
        self._allocate_gradients(device)
        self._make_optimizers(device.startswith("cuda"))

    def _allocate_gradients(self, device: str) -> None:
        parts = [*self.actor.parameters()], [self.log_temperature], [*self.critics.parameters()]
        self._policy_parameters, self._temperature_parameters, self._critic_parameters = parts
        policy, _, critics = (sum(parameter.numel() for parameter in part) for part in parts)
        losses = policy + 1
        self._shared = torch.zeros(losses + len(LOSSES) + critics, device=device)
        for offset, part in zip((0, policy, losses + len(LOSSES)), parts, strict=True):
            keep_gradients(part, self._shared[offset:])
        self._policy_gradients = [each.grad for each in self._policy_parameters if each.grad is not None]
        self._critic_gradients = [each.grad for each in self._critic_parameters if each.grad is not None]
        self._policy_gradient, self._critic_gradient = self._shared[:policy], self._shared[-critics:]
        self._temperature_gradient = self._shared[policy]
        self.losses = self._shared[losses : losses + len(LOSSES)]
        """:data:`LOSSES` of the newest update, shape (4,); the first two are 0 where the policy did not learn."""
        self._of_critics = self._shared[losses + LOSSES.index("critic_loss") :]

    def _make_optimizers(self, cuda: bool) -> None:
        config, decay = self.config, self.config.weight_decay
        options: dict[str, Any] = {"betas": BETAS, "fused": True, "capturable": cuda}
        policy = {"params": self._policy_parameters, "lr": config.actor_learning_rate, "weight_decay": decay}
        rate = config.temperature_learning_rate
        temperature = {"params": self._temperature_parameters, "lr": rate, "weight_decay": 0.0}
        critics = {"params": self._critic_parameters, "lr": config.critic_learning_rate, "weight_decay": decay}
        self._policy_optimizer = torch.optim.AdamW([policy, temperature], **options)
        self._critic_optimizer = torch.optim.AdamW([critics], **options)

    @property
    def temperature(self) -> torch.Tensor:
        """The temperature, the value of the policy's entropy [reward per nat], shape (), on the device."""
        return self.log_temperature.detach().exp()

    def shared(self, improves: bool) -> torch.Tensor:
        """The buffer to sum over the ranks after :meth:`compute`."""
        return self._shared if improves else self._of_critics

    def compute(self, batch: Batch, noise: torch.Tensor, improves: bool) -> None:
        """This rank's share of the gradients and losses of one update.

        Args:
            batch: The sampled transitions.
            noise: Standard normal noise of the actions after and at the beginning of the transition; shape (2, samples, actions).
            improves: Whether policy and temperature learn too.
        """
        self.losses.zero_()
        share = 1.0 / self.config.batch_size  # the batch is all ranks' together
        actions = batch.before[:, self.width :]
        before, critics_before = self._normalize(batch.before)
        after, critics_after = self._normalize(batch.after)
        temperature = self.temperature
        with torch.no_grad():
            following, log_prob = self.actor.sample(after, noise[0])
            target = self.target(self.targets(critics_after, following), batch, -temperature * log_prob)
            if self.config.atoms > 1:
                self.mass.add_(target[:, -1].sum(), alpha=share)
        outputs = self.critics(critics_before, actions)
        if self.config.atoms == 1:
            error = (outputs - target).square().sum()
        else:  # the cross entropy
            error = -(target * log_softmax(outputs, -1)).sum()
        critic_loss = error * share
        torch._foreach_copy_(self._critic_gradients, torch.autograd.grad(critic_loss, self._critic_parameters))
        self.losses[2].copy_(critic_loss.detach())
        self.losses[3].copy_(self.critics.mean(outputs.detach()).mean(0).sum() * share)
        if improves:
            chosen, log_prob = self.actor.sample(before, noise[1])
            value = self.critics.combined_mean(self.critics(critics_before, chosen))
            policy_loss = (temperature * log_prob - value).sum() * share
            torch._foreach_copy_(self._policy_gradients, torch.autograd.grad(policy_loss, self._policy_parameters))
            entropy = -log_prob.detach()
            # of J(α) = α · E[−log π − H] (arXiv:1812.05905, eq. 18), by log α
            excess = entropy - self.config.target_entropy * self._actions
            self._temperature_gradient.copy_(temperature * excess.sum() * share)
            self.losses[0].copy_(policy_loss.detach())
            self.losses[1].copy_(entropy.sum() * share)

    def _normalize(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The observations of the policy and of the critics, from rows of all observations; the same tensor if both have the same group."""
        groups = [normalizer(rows[:, at]) for normalizer, at in zip(self.normalizers, self.columns, strict=True)]
        return groups[0], groups[-1]

    def target(self, outputs: torch.Tensor, batch: Batch, bonuses: torch.Tensor) -> torch.Tensor:
        """The critics' targets: a distribution, shape (samples, atoms), or, with one atom, the return, shape (samples, 1).

        Args:
            outputs: Outputs of the target critics after the transition, shape (critics, samples, atoms).
            batch: The sampled transitions.
            bonuses: −α · log π of the next action, shape (samples,).
        """
        config = self.config
        if config.atoms == 1:
            after = self.targets.combined_mean(outputs) + bonuses
            return (batch.returns + batch.discounts * after).unsqueeze(1)
        probabilities = self.targets.combined_distribution(outputs)
        ends = config.v_min, config.v_max
        return kernels.project(probabilities, batch.returns, batch.discounts, bonuses, *ends, self._projected)

    @torch.no_grad()
    def apply(self, improves: bool) -> None:
        """A step of AdamW with the gradients of all ranks; then the target critics follow."""
        if improves:
            self._clip(self._policy_gradient)
            self._policy_optimizer.step()
        self.norm.add_(torch.linalg.vector_norm(self._critic_gradient))
        self._clip(self._critic_gradient)
        self._critic_optimizer.step()
        torch._foreach_lerp_([*self.targets.parameters()], [*self.critics.parameters()], self.config.tau)

    def _clip(self, gradient: torch.Tensor) -> None:
        if limit := self.config.max_grad_norm:
            norm = torch.dot(gradient, gradient).sqrt()
            gradient.mul_((limit / (norm + 1e-6)).clamp(max=1.0))

    def state_dict(self) -> dict[str, Any]:
        """Networks, normalisers, temperature and optimizers."""
        return {
            "policy": self.actor.state_dict(),
            "critics": self.critics.state_dict(),
            "targets": self.targets.state_dict(),
            "critic_normalizers": [each.state_dict() for each in self.normalizers[1:]],
            "log_temperature": self.log_temperature.detach(),
            "policy_optimizer": self._policy_optimizer.state_dict(),
            "critic_optimizer": self._critic_optimizer.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any], *, weights_only: bool = False) -> None:
        """Continue from :meth:`state_dict`; ``weights_only``: with new optimizers and the temperature of the settings.

        The temperature weighs entropy against rewards, which may have changed.
        """
        self.actor.load_state_dict(state["policy"])
        self.critics.load_state_dict(state["critics"])
        self.targets.load_state_dict(state["targets"])
        for normalizer, saved in zip(self.normalizers[1:], state["critic_normalizers"], strict=True):
            normalizer.load_state_dict(saved)
        if not weights_only:
            self.log_temperature.data.copy_(state["log_temperature"])
        for name, optimizer in (("policy", self._policy_optimizer), ("critic", self._critic_optimizer)):
            if weights_only:
                optimizer.state.clear()
            else:
                load_optimizer(optimizer, state[f"{name}_optimizer"])
