"""PPO in one file, to be read from top to bottom: the reference with which the tests compare algorithm ``ppo``.

It has numbers alone, neither choices nor images, and Adam. In comments, S steps of the W worlds of this rank are a rollout, and N = S · W
its samples: step s of world w is row s · W + w.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

import torch
from rsl_rl.utils import resolve_nn_activation
from tensordict import TensorDict
from torch import nn
from torch.distributions import Normal, kl_divergence

from worker.learning.algorithm import POLICY, ExportedPolicy, LearningSetting, Spaces, Transition
from worker.learning.ppo import draws
from worker.learning.ppo.draws import Draws
from worker.settings.ppo import PPOConfig


class Network(nn.Module):
    """A multi-layer perceptron after a normaliser, which scales its inputs to about unit variance."""

    mean: torch.Tensor
    variance: torch.Tensor
    count: torch.Tensor

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int, config: PPOConfig) -> None:
        super().__init__()
        self.normalizes = config.normalize_observations
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("variance", torch.ones(inputs))
        self.register_buffer("count", torch.tensor(0))
        layers: list[nn.Module] = []
        for size, following in itertools.pairwise([inputs, *hidden]):
            layers += [nn.Linear(size, following), resolve_nn_activation(config.activation)]
        self.layers = nn.Sequential(*layers, nn.Linear(hidden[-1], outputs))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (…, outputs) for observations of shape (…, inputs)."""
        if self.normalizes:
            observations = (observations - self.mean) / (self.variance.sqrt() + 0.01)
        outputs: torch.Tensor = self.layers(observations)
        return outputs

    @torch.no_grad()
    def update_normalizer(self, observations: torch.Tensor, setting: LearningSetting) -> None:
        """Merge mean and variance of an iteration's observations, shape (N, inputs), of all ranks, into those of all before."""
        new, gang = observations.double(), setting.gang
        count = len(new) // setting.share.count * setting.share.total
        mean = gang.sum(new.sum(0)) / count
        variance = gang.sum((new - mean).square().sum(0)) / count
        self.count += count
        part, apart = count / self.count, mean - self.mean
        self.variance.copy_((1 - part) * self.variance + part * variance + part * (1 - part) * apart.square())
        self.mean.add_(part * apart)


class GaussianActor(Network):
    """The policy: the network's output is the mean of the actions; the standard deviation of each action is also learnt."""

    def __init__(self, spaces: Spaces, config: PPOConfig) -> None:
        super().__init__(spaces.observations[POLICY][0], config.hidden_sizes, spaces.actions, config)
        self.std = nn.Parameter(torch.full((spaces.actions,), config.init_std))

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """The best action is the mean: shape (worlds, actions)."""
        best: torch.Tensor = self(observations[POLICY])
        return best

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Do nothing: the policy has no recurrent state."""

    def module(self) -> ExportedPolicy:
        """The network itself, with typical observations to compare the exported file on."""
        network = copy.deepcopy(self).cpu().eval()
        seen = torch.randn(256, len(network.mean), generator=torch.Generator().manual_seed(0))
        seen.mul_(network.variance.sqrt()).add_(network.mean)
        return ExportedPolicy(network, {"obs": seen[:1]}, ["actions"], TensorDict({POLICY: seen}, [len(seen)]))


class PlainPPO:
    """See :class:`worker.learning.algorithm.Algorithm`."""

    config_type: ClassVar[type[PPOConfig]] = PPOConfig
    captures_rollout: ClassVar[bool] = False
    kernels: ClassVar[Sequence[Any]] = (draws,)
    graphs: Sequence[Any] = ()

    def __init__(self, config: PPOConfig, setting: LearningSetting) -> None:
        group, groups = config.critic_observations, setting.spaces.observations
        self.config, self.setting, self.gang, self.steps = config, setting, setting.gang, config.steps
        device, self.rate = setting.gang.device, config.learning_rate
        self.actor = GaussianActor(setting.spaces, config)
        self.critic = Network(groups[group][0], config.critic_hidden_sizes or config.hidden_sizes, 1, config)
        self.parameters = [*self.actor.to(device).parameters(), *self.critic.to(device).parameters()]
        for parameter in self.parameters:
            self.gang.broadcast(parameter.data)  # every rank begins with the main rank's weights
        self.optimizer = torch.optim.Adam(self.parameters, self.rate, foreach=False)
        self._draws = Draws(setting.seed, setting.share.first, device)
        self._rollout: list[dict[str, torch.Tensor]] = []

    def begin(self, iteration: int) -> None:
        """Seed the random numbers, which depend only on the seed, the iteration and the world; apply what settles with time."""
        self._draws.begin(iteration)
        self._greatest_rate = self.config.greatest_rate(iteration)
        if self.config.schedule == "adaptive" and self.config.learning_rate_horizon is not None:
            self.rate = min(self.rate, self._greatest_rate)
        self._normalizer_learns = self.config.normalize_observations and self.config.normalizer_learns(iteration)
        self._rollout.clear()

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """Draw actions around the policy's mean: shape (W, actions)."""
        seen, judged = observations[POLICY].clone(), observations[self.config.critic_observations].clone()
        means = self.actor(seen)
        actions = self._draws.normal(len(self._rollout), means, self.actor.std.detach(), torch.empty_like(means))
        self._rollout.append({"seen": seen, "judged": judged, "means": means, "actions": actions})
        return actions

    def record(self, step: Transition) -> None:
        """Keep the result of the actions, in copies, since the task's own tensors change in the next step."""
        ends = step.terminal_observations[self.config.critic_observations]
        came = {"rewards": step.rewards, "dones": step.dones, "time_outs": step.time_outs, "ends": ends}
        self._rollout[-1] |= {name: tensor.clone() for name, tensor in came.items()}

    def learn(self, observations: TensorDict) -> dict[str, torch.Tensor]:
        """Several passes over the rollout, each in minibatches of its own. ``observations`` are those after the last step."""
        config, worlds, device = self.config, self.setting.share.count, self.gang.device
        samples, old_deviation = self._estimate(observations), self.actor.std.detach().clone()
        # samples of each minibatch: the same number of steps of every world, shape (epochs · minibatches, steps, W)
        shape = config.epochs * config.minibatches, self.steps // config.minibatches, worlds
        orders = torch.zeros(shape, dtype=torch.long, device=device)
        scratch = torch.zeros(config.epochs, worlds, self.steps, dtype=torch.int32, device=device)
        self._draws.order(orders, scratch)
        # each rank's mean is weighted by its share of worlds, so that the sum over the ranks is the mean over all samples
        weight = worlds / self.setting.share.total
        sums, clipped, norms = (
            torch.zeros(4, device=device),
            torch.zeros((), device=device),
            torch.zeros((), device=device),
        )
        for rows in orders.flatten(1):
            loss, parts, beyond = self._loss({name: tensor[rows] for name, tensor in samples.items()}, old_deviation)
            self.optimizer.zero_grad()
            (weight * loss).backward()
            for parameter in self.parameters:
                assert parameter.grad is not None
                self.gang.sum(parameter.grad)
            parts = self.gang.sum(weight * parts)
            sums += parts
            clipped += weight * beyond
            if config.schedule == "adaptive":
                self.rate = self._adapted_rate(kl=float(parts[3]))
            found = [
                nn.utils.clip_grad_norm_(each.parameters(), config.max_grad_norm) for each in (self.actor, self.critic)
            ]
            norms += torch.stack(found).norm()
            self.optimizer.param_groups[0]["lr"] = self.rate
            self.optimizer.step()
            self._limit_deviation()
        if self._normalizer_learns:
            self.actor.update_normalizer(samples["seen"], self.setting)
            self.critic.update_normalizer(samples["judged"], self.setting)
        losses = dict(zip(("surrogate_loss", "value_loss", "entropy", "kl"), sums / len(orders), strict=True))
        rate, norm = torch.tensor(self.rate, device=device), norms / len(orders)
        figures = {"learning_rate": rate, "action_std": old_deviation.mean(), "gradient_norm": norm}
        return {**losses, **figures, **self._describe(samples, clipped / len(orders))}

    @torch.no_grad()
    def _limit_deviation(self) -> None:
        """Bring the standard deviation back into its limits. A clamp in the loss would have no gradient beyond them."""
        self.actor.std.clamp_(*self.config.std_limits)

    def _describe(self, samples: dict[str, torch.Tensor], clipped: torch.Tensor) -> dict[str, torch.Tensor]:
        """Shares over all ranks: of the returns' variance that the critic explained, of ratios that were clipped, and of actions beyond
        their range. ``clipped``: this rank's part of the second."""
        returns, errors = samples["returns"].double(), (samples["returns"] - samples["values"]).double()
        ranges = [each or (-math.inf, math.inf) for each in self.setting.action_ranges] or [(-math.inf, math.inf)]
        least, greatest = torch.tensor(ranges, device=returns.device).t()
        beyond = (samples["actions"] < least) | (samples["actions"] > greatest)
        squares = returns.square().sum(), errors.square().sum()
        sums = self.gang.sum(
            torch.stack((returns.sum(), errors.sum(), *squares, beyond.sum().double(), clipped.double()))
        )
        count = self.setting.share.total * self.steps
        of_returns, of_errors = sums[2:4] - sums[:2].square() / count  # count · variance
        figures = {"explained_variance": 1 - of_errors / of_returns.clamp(min=1e-12), "clip_fraction": sums[5]}
        if limited := sum(each is not None for each in self.setting.action_ranges):
            figures["saturation"] = sums[4] / (count * limited)
        return figures

    @torch.no_grad()
    def _estimate(self, observations: TensorDict) -> dict[str, torch.Tensor]:
        """How good was each action? Generalised advantage estimation (arXiv:1506.02438). Gives the samples, shape (N, …) by name."""
        config = self.config
        rollout = {name: torch.stack([step[name] for step in self._rollout]) for name in self._rollout[0]}  # (S, W, …)
        values = self.critic(rollout["judged"]).squeeze(-1)
        # after a time-out, the value of the future belongs to the last reward
        future = self.critic(rollout["ends"]).squeeze(-1)  # meaningless, perhaps NaN, where no episode ended
        rewards = rollout["rewards"] + config.gamma * torch.where(rollout["time_outs"], future, 0.0)
        next_values = self.critic(observations[config.critic_observations]).squeeze(-1)
        advantages, advantage = torch.zeros_like(values), torch.zeros_like(next_values)
        for step in reversed(range(self.steps)):
            going_on = (~rollout["dones"][step]).float()
            surprise = rewards[step] + config.gamma * going_on * next_values - values[step]
            advantage = surprise + config.gamma * config.lam * going_on * advantage
            advantages[step], next_values = advantage, values[step]
        returns = advantages + values
        # normalise the advantages: mean 0 and standard deviation 1 over the samples of all ranks
        count = self.setting.share.total * self.steps
        mean = self.gang.sum(advantages.double().sum()) / count
        variance = self.gang.sum((advantages - mean).square().sum()) / (count - 1)
        advantages = (advantages - mean) / (variance.sqrt() + 1e-8)
        policy = Normal(rollout["means"], self.actor.std, validate_args=False)
        log_probs = policy.log_prob(rollout["actions"]).sum(-1)
        known = {**rollout, "values": values, "returns": returns, "advantages": advantages, "log_probs": log_probs}
        return {name: tensor.flatten(0, 1) for name, tensor in known.items()}

    def _loss(self, batch: dict[str, torch.Tensor], old_deviation: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Proximal policy optimisation's (arXiv:1707.06347) loss of one minibatch, shape (), and its metrics, shape (4,), and the share of clipped ratios."""
        config, clip = self.config, self.config.clip
        policy = Normal(self.actor(batch["seen"]), self.actor.std, validate_args=False)
        # probability ratio of the action, new over old policy; no gradient beyond the clip range
        ratio = (policy.log_prob(batch["actions"]).sum(-1) - batch["log_probs"]).exp()
        gain, clipped_gain = batch["advantages"] * ratio, batch["advantages"] * ratio.clamp(1.0 - clip, 1.0 + clip)
        surrogate = -torch.minimum(gain, clipped_gain).mean()
        values = self.critic(batch["judged"]).squeeze(-1)
        error = (values - batch["returns"]).square()
        if config.clip_values:
            near = batch["values"] + (values - batch["values"]).clamp(-clip, clip)
            error = torch.maximum(error, (near - batch["returns"]).square())
        entropy = policy.entropy().sum(-1).mean()
        kl = kl_divergence(Normal(batch["means"], old_deviation, validate_args=False), policy).sum(-1).mean()
        loss = surrogate + config.value_loss_coef * error.mean() - config.entropy_coef * entropy
        clipped = ((ratio - 1.0).abs() > clip).float().mean()
        return loss, torch.stack((surrogate, error.mean(), entropy, kl)).detach(), clipped

    def _adapted_rate(self, kl: float) -> float:
        """A smaller rate if the policy has moved too far from the old one, a greater one if it has hardly moved (rsl-rl's rule)."""
        least, greatest, desired = self.config.learning_rate_limits[0], self._greatest_rate, self.config.desired_kl
        if kl > 2.0 * desired:
            return max(self.rate / 1.5, least)
        return min(self.rate * 1.5, greatest) if 0.0 < kl < desired / 2.0 else self.rate

    def policy(self) -> GaussianActor:
        """The actor is the policy."""
        return self.actor

    def state_dict(self) -> dict[str, Any]:
        """Networks with their normalisers, optimizer and learning rate."""
        parts: dict[str, nn.Module | torch.optim.Optimizer] = {
            "policy": self.actor,
            "critic": self.critic,
            "optimizer": self.optimizer,
        }
        return {**{name: part.state_dict() for name, part in parts.items()}, "learning_rate": self.rate}

    def load_state_dict(self, state: Any, *, weights_only: bool = False, changed: Collection[str] = ()) -> list[str]:
        """Continue from :meth:`state_dict`; an adaptive schedule keeps the saved learning rate, unless the job sets another one."""
        self.actor.load_state_dict(state["policy"])
        self._limit_deviation()
        self.critic.load_state_dict(state["critic"])
        if weights_only:
            return []
        self.optimizer.load_state_dict(state["optimizer"])
        keeps = self.config.schedule == "adaptive" and "learning_rate" not in changed
        self.rate = float(state["learning_rate"]) if keeps else self.config.learning_rate
        return [] if self.rate == state["learning_rate"] else [f"learning rate set to {self.rate:g}"]

    def world_state(self) -> dict[str, torch.Tensor]:
        """This algorithm keeps no state per world."""
        return {}

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """This algorithm keeps no state per world."""

    @classmethod
    def build_policy(cls, config: PPOConfig, spaces: Spaces, device: str) -> GaussianActor:
        """The actor alone."""
        return GaussianActor(spaces, config).to(device).eval()
