"""The policy and the critics."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.modules.normalization import EmpiricalNormalization
from tensordict import TensorDict
from torch import nn
from torch.nn.functional import layer_norm, silu, softplus

from worker.learning.algorithm import POLICY, ExportedPolicy, Spaces
from worker.learning.observations import made_up
from worker.learning.sac.settings import LOG_STD, SACConfig

HEAD_SCALE = 0.01
"""First weights of the last layers, as a part of torch's: so the first policy is centred, and the first critics expect nothing."""


def size_of(spaces: Spaces, group: str) -> int:
    """Length of one observation of a group. Raises ValueError where there is no such group, or where it is one of images."""
    if group not in spaces.observations:
        known = ", ".join(spaces.observations)
        raise ValueError(f"sac.critic_group: there is no observation group {group!r}; there are {known}")
    shape = spaces.observations[group]
    if len(shape) != 1:
        raise ValueError(f"sac: it can't learn from images, and observation group {group!r} is one; use ppo")
    return shape[0]


class Actor(nn.Module):
    """A Gaussian, squashed into the action's limits by tanh (arXiv:1812.05905, appendix C), with its normaliser inside."""

    def __init__(self, config: SACConfig, observations: int, actions: int) -> None:
        super().__init__()
        self.observations, self.limit = observations, config.action_limit
        self.normalizer = make_normalizer(config, observations)
        layers: list[nn.Module] = []
        width = observations
        for size in config.actor_sizes:
            layers.append(nn.Linear(width, size))
            if config.layer_norm:
                layers.append(nn.LayerNorm(size))
            layers.append(nn.SiLU())
            width = size
        self.body = nn.Sequential(*layers)
        self.head = nn.Linear(width, 2 * actions)
        low, high = LOG_STD
        with torch.no_grad():
            self.head.weight.mul_(HEAD_SCALE)
            self.head.bias.zero_()
            self.head.bias[actions:] = math.atanh(2.0 * (math.log(config.init_std) - low) / (high - low) - 1.0)

    def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and logarithm of the standard deviation, before squashing.

        Args:
            observations: As the task gives them, shape (n, observations), float32.

        Returns:
            Two of shape (n, actions).
        """
        return self.spread(self.normalizer(observations))

    def spread(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What :meth:`forward` gives, for observations that are normalised already."""
        mean, raw = self.head(self.body(observations)).chunk(2, dim=-1)
        low, high = LOG_STD
        return mean, low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)

    def sample(self, observations: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions, and the logarithm of their density in units of the limit.

        The density of a = tanh(u) is that of u over the slope of tanh, 1 − a². Its logarithm is 2·(log 2 − u − softplus(−2u)), which
        stays finite where a is 1 in float32.

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

    def best(self, observations: torch.Tensor) -> torch.Tensor:
        """The action without noise, shape (n, actions), for observations as the task gives them."""
        return self.limit * torch.tanh(self(observations)[0])


class Critics(nn.Module):
    """Several critics of one shape, computed as one: their weights lie in one tensor for each layer.

    A critic gives ``atoms`` numbers: the logits of a distribution of the return; of one atom, its mean.
    """

    values: torch.Tensor

    def __init__(self, config: SACConfig, observations: int, actions: int) -> None:
        super().__init__()
        sizes = [observations + actions, *config.critic_sizes, config.atoms]
        self.combine, self.atoms, self.layer_norm = config.combine, config.atoms, config.layer_norm
        self.weights, self.biases, self.gains, self.offsets = (nn.ParameterList() for _ in range(4))
        for i, (before, after) in enumerate(itertools.pairwise(sizes)):
            last = i == len(sizes) - 2
            bound = (HEAD_SCALE if last else 1.0) / math.sqrt(before)  # as torch's linear layers
            self.weights.append(torch.empty(config.critics, before, after).uniform_(-bound, bound))
            self.biases.append(torch.empty(config.critics, 1, after).uniform_(-bound, bound))
            if self.layer_norm and not last:
                self.gains.append(torch.ones(config.critics, 1, after))
                self.offsets.append(torch.zeros(config.critics, 1, after))
        atoms = torch.linspace(config.v_min, config.v_max, config.atoms)
        self.register_buffer("values", atoms, persistent=False)

    def forward(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """What each critic says.

        Args:
            observations: Normalised, shape (n, observations).
            actions: Shape (n, actions).

        Returns:
            Shape (critics, n, atoms).
        """
        x = torch.cat((observations, actions), -1).expand(len(self.weights[0]), -1, -1)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if i < len(self.weights) - 1:
                if self.layer_norm:
                    x = torch.addcmul(self.offsets[i], layer_norm(x, x.shape[-1:]), self.gains[i])
                x = silu(x)
        return x

    def mean(self, outputs: torch.Tensor) -> torch.Tensor:
        """The return that each critic expects, shape (critics, n), from what :meth:`forward` gave."""
        return outputs[..., 0] if self.atoms == 1 else outputs.softmax(-1) @ self.values

    def combined_mean(self, outputs: torch.Tensor) -> torch.Tensor:
        """The return that they expect together, shape (n,): the mean or the least over the critics."""
        means = self.mean(outputs)
        return means.mean(0) if self.combine == "mean" else means.amin(0)

    def combined_distribution(self, outputs: torch.Tensor) -> torch.Tensor:
        """The probabilities of the atoms that they give together, shape (n, atoms).

        ``"mean"``: the mean over the critics, whose mean is that of their means; ``"min"``: those of the critic that expects least.
        """
        probabilities = outputs.softmax(-1)
        if self.combine == "mean":
            return probabilities.mean(0)
        least = (probabilities @ self.values).argmin(0)
        return probabilities.gather(0, least.view(1, -1, 1).expand(1, -1, self.atoms))[0]


class SquashedPolicy:
    """What SAC learnt: the mean action, squashed."""

    def __init__(self, actor: Actor) -> None:
        self.actor = actor

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """The best action for each world, shape (n, actions), float32."""
        best: torch.Tensor = self.actor.best(observations[POLICY])
        return best

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Nothing is remembered of an episode."""

    def module(self) -> ExportedPolicy:
        """The mean action as a function of ``obs``, shape (batch, observations); the observations are normalised inside."""
        network = _Best(self.actor)
        seen = made_up({POLICY: (self.actor.observations,)}, network.actor.normalizer)
        return ExportedPolicy(network, {"obs": seen[POLICY][:1]}, ("actions",), seen)

    def state_dict(self) -> Mapping[str, Any]:
        """The actor's tensors, with its normaliser's."""
        state: Mapping[str, Any] = self.actor.state_dict()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        """Take over what :meth:`state_dict` gave. Raises RuntimeError where it does not fit."""
        return self.actor.load_state_dict(state)


class _Best(nn.Module):
    """The mean action as a module of its own, on the CPU."""

    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self.actor = copy.deepcopy(actor).cpu()
        self.eval()

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.actor.best(obs)


def make_normalizer(config: SACConfig, size: int) -> nn.Module:
    """Makes observations, shape (n, size), have mean 0 and deviation 1; or leaves them as they are."""
    return EmpiricalNormalization(size) if config.normalize_observations else nn.Identity()


def check_spaces(spaces: Spaces, groups: Sequence[str]) -> None:
    """Raises ValueError, in one line, for spaces that SAC can't learn in."""
    if spaces.discrete:
        raise ValueError("sac: its actions are numbers from a range, and this task's are choices; use ppo")
    for group in groups:
        size_of(spaces, group)
