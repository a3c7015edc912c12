"""The networks of SAC: the policy and the critics."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator, Sequence

import torch
from rsl_rl.modules.normalization import EmpiricalNormalization
from tensordict import TensorDict
from torch import nn
from torch.nn.functional import softplus

from worker.learning.algorithm import POLICY, ExportedPolicy, Spaces
from worker.learning.observations import synthetic
from worker.settings.sac import LOG_STD, SACConfig

HEAD_SCALE = 0.01
"""Scale of the last layers' initial weights, relative to torch's: the first policy is centred, and the first critics predict 0."""


def size_of(spaces: Spaces, group: str) -> int:
    """Length of one observation of a group. Raises ValueError for an unknown group or a group of images."""
    if group not in spaces.observations:
        known = ", ".join(spaces.observations)
        raise ValueError(f"sac.critic_group: there is no observation group {group!r}; available: {known}")
    shape = spaces.observations[group]
    if len(shape) != 1:
        raise ValueError(f"sac: it can't learn from images, and observation group {group!r} is one; use ppo")
    return shape[0]


def hidden_layers(sizes: Sequence[int], layer_norm: bool) -> Iterator[nn.Module]:
    """Layers from an input of ``sizes[0]`` numbers over widths of ``sizes[1:]``, each normalised if ``layer_norm``."""
    for before, after in itertools.pairwise(sizes):
        yield nn.Linear(before, after)
        if layer_norm:
            yield nn.LayerNorm(after)
        yield nn.SiLU()


class SquashedGaussianActor(nn.Module):
    """SAC's policy: a Gaussian, squashed into the action's limits by tanh (arXiv:1812.05905, appendix C), with its normaliser inside."""

    def __init__(self, config: SACConfig, observations: int, actions: int) -> None:
        super().__init__()
        self.observations, self.limit = observations, config.action_limit
        self.normalizer = make_normalizer(config, observations)
        self.body = nn.Sequential(*hidden_layers((observations, *config.actor_sizes), config.layer_norm))
        self.head = nn.Linear(config.actor_sizes[-1], 2 * actions)
        low, high = LOG_STD
        with torch.no_grad():
            self.head.weight.mul_(HEAD_SCALE)
            self.head.bias.zero_()
            self.head.bias[actions:] = math.atanh(2.0 * (math.log(config.init_std) - low) / (high - low) - 1.0)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """The best action, the squashed mean, shape (n, actions), for observations of the task, shape (n, observations), float32."""
        return self.limit * torch.tanh(self.spread(self.normalizer(obs))[0])

    def spread(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and logarithm of the standard deviation, before squashing, each of shape (n, actions), for normalised observations."""
        mean, raw = self.head(self.body(observations)).chunk(2, dim=-1)
        low, high = LOG_STD
        return mean, low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)

    def sample(self, observations: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions, and the logarithm of their density in units of the limit.

        The density of a = tanh(u) is that of u over the slope of tanh, 1 − a². The slope's logarithm is 2·(log 2 − u − softplus(−2u)),
        which stays finite even if a is 1 in float32.

        Args:
            observations: Normalised, shape (n, observations).
            noise: Standard normal, shape (n, actions).

        Returns:
            Shapes (n, actions) and (n,).
        """
        mean, log_std = self.spread(observations)
        before = mean + log_std.exp() * noise
        normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
        slope = 2.0 * (math.log(2.0) - before - softplus(-2.0 * before))
        return self.limit * torch.tanh(before), (normal - slope).sum(-1)

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """The best action for each world, shape (n, actions), float32."""
        actions: torch.Tensor = self(observations[POLICY])
        return actions

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """No-op: the policy has no recurrent state."""

    def module(self) -> ExportedPolicy:
        """A copy on the CPU, with the input ``obs``; the observations are normalised inside."""
        network = copy.deepcopy(self).cpu().eval()
        sample = synthetic({POLICY: (self.observations,)}, network.normalizer)
        return ExportedPolicy(network, {"obs": sample[POLICY][:1]}, ("actions",), sample)


class Critics(nn.Module):
    """Several critics of one shape.

    A critic outputs ``atoms`` numbers: the logits of a distribution of the return, or with one atom its mean.
    """

    values: torch.Tensor

    def __init__(self, config: SACConfig, observations: int, actions: int) -> None:
        super().__init__()
        self.combine, self.atoms = config.combine, config.atoms
        each = [
            nn.Sequential(
                *hidden_layers((observations + actions, *config.critic_sizes), config.layer_norm),
                nn.Linear(config.critic_sizes[-1], config.atoms),
            )
            for _ in range(config.critics)
        ]
        self.each = nn.ModuleList(each)
        with torch.no_grad():
            for critic in each:
                for parameter in critic[-1].parameters():
                    parameter.mul_(HEAD_SCALE)
        atoms = torch.linspace(config.v_min, config.v_max, config.atoms)
        self.register_buffer("values", atoms, persistent=False)

    def forward(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """The output of each critic.

        Args:
            observations: Normalised, shape (n, observations).
            actions: Shape (n, actions).

        Returns:
            Shape (critics, n, atoms).
        """
        x = torch.cat((observations, actions), -1)
        return torch.stack([critic(x) for critic in self.each])

    def mean(self, outputs: torch.Tensor) -> torch.Tensor:
        """The return that each critic expects, shape (critics, n), from the result of :meth:`forward`."""
        return outputs[..., 0] if self.atoms == 1 else outputs.softmax(-1) @ self.values

    def combined_mean(self, outputs: torch.Tensor) -> torch.Tensor:
        """The combined expected return, shape (n,): the mean or the least over the critics."""
        means = self.mean(outputs)
        return means.mean(0) if self.combine == "mean" else means.amin(0)

    def combined_distribution(self, outputs: torch.Tensor) -> torch.Tensor:
        """The combined probabilities of the atoms, shape (n, atoms).

        ``"mean"``: the mean over the critics; ``"min"``: those of the critic with the least expected return.
        """
        probabilities = outputs.softmax(-1)
        if self.combine == "mean":
            return probabilities.mean(0)
        least = (probabilities @ self.values).argmin(0)
        return probabilities.gather(0, least.view(1, -1, 1).expand(1, -1, self.atoms))[0]


def make_normalizer(config: SACConfig, size: int) -> nn.Module:
    """Normalise observations, shape (n, size), to mean 0 and standard deviation 1; or leave them unchanged."""
    return EmpiricalNormalization(size) if config.normalize_observations else nn.Identity()


def check_spaces(spaces: Spaces, groups: Sequence[str]) -> None:
    """Raises ValueError, in one line, for spaces that SAC does not support."""
    if spaces.discrete:
        raise ValueError("sac: its actions are continuous, and this task's are choices; use ppo")
    for group in groups:
        size_of(spaces, group)
