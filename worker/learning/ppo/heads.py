"""The heads of the actor: how its outputs are interpreted, how actions are drawn from them, and PPO's clipped loss with its gradient."""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution

from worker.learning.parts import launch
from worker.learning.ppo.draws import Draws
from worker.learning.ppo.networks import PixelModel
from worker.learning.ppo.rollout_buffer import RolloutBuffer
from worker.settings.ppo import PPOConfig

LOSSES = ("surrogate_loss", "value_loss", "entropy", "kl")
"""Names of the metrics of every minibatch."""
_LOG_ROOT_TWO_PI = 0.9189385332046727
_HALF_LOG_TWO_PI = wp.constant(_LOG_ROOT_TWO_PI)
wp.set_module_options({"enable_backward": False})


@wp.kernel
def _objective(
    rows: wp.array[wp.int64],
    actions: wp.array2d[wp.float32],
    old_mean: wp.array2d[wp.float32],
    old_log_prob: wp.array[wp.float32],
    advantages: wp.array[wp.float32],
    returns: wp.array[wp.float32],
    old_values: wp.array[wp.float32],
    old_std: wp.array[wp.float32],
    mean: wp.array2d[wp.float32],
    std: wp.array[wp.float32],
    values: wp.array[wp.float32],
    clip: wp.float32,
    clip_values: wp.bool,
    value_coef: wp.float32,
    entropy_coef: wp.float32,
    scale: wp.float32,
    mean_gradient: wp.array2d[wp.float32],
    value_gradient: wp.array[wp.float32],
    terms: wp.array2d[wp.float32],
    clip_counts: wp.array[wp.float32],
):
    """:func:`clipped_loss` of one sample of a diagonal Gaussian, and its gradient, in one kernel instead of a hundred small ones.

    Columns of ``terms`` are :data:`LOSSES`, then the gradient of each component of the deviation. Ratios beyond the clip range are
    counted. Comparisons are such that NaN, which none of them holds for, goes on into losses and gradients.
    """
    i = wp.tid()
    row = rows[i]
    log_prob = wp.float32(0.0)
    entropy = wp.float32(0.0)
    kl = wp.float32(0.0)
    for j in range(mean.shape[1]):
        distance = (actions[row, j] - mean[i, j]) / std[j]
        log_prob -= 0.5 * distance * distance + wp.log(std[j]) + _HALF_LOG_TWO_PI
        entropy += 0.5 + _HALF_LOG_TWO_PI + wp.log(std[j])
        ratio_of_std = old_std[j] / std[j]
        moved = (old_mean[row, j] - mean[i, j]) / std[j]
        kl += 0.5 * (ratio_of_std * ratio_of_std + moved * moved - 1.0) - wp.log(ratio_of_std)

    advantage = advantages[row]
    ratio = wp.exp(log_prob - old_log_prob[row])
    surrogate = -advantage * ratio
    slope = surrogate  # d surrogate / d log_prob
    if ratio < 1.0 - clip or ratio > 1.0 + clip:
        clip_counts[i] += 1.0
        clipped = -advantage * wp.clamp(ratio, 1.0 - clip, 1.0 + clip)
        if clipped >= surrogate:
            surrogate = clipped
            slope = 0.0

    error = values[i] - returns[row]
    value = error * error
    value_slope = 2.0 * error
    change = values[i] - old_values[row]
    if clip_values and (change < -clip or change > clip):
        near = old_values[row] + wp.clamp(change, -clip, clip) - returns[row]
        if near * near >= value:
            value = near * near
            value_slope = 0.0

    value_gradient[i] = scale * value_coef * value_slope
    terms[i, 0] = scale * surrogate
    terms[i, 1] = scale * value
    terms[i, 2] = scale * entropy
    terms[i, 3] = scale * kl
    for j in range(mean.shape[1]):
        distance = (actions[row, j] - mean[i, j]) / std[j]
        mean_gradient[i, j] = scale * slope * distance / std[j]
        terms[i, 4 + j] = scale * (slope * (distance * distance - 1.0) - entropy_coef) / std[j]


class Gaussian:
    """Actions are normal around the outputs, with a learnt standard deviation each.

    Args:
        actor: The network, on its device.
        samples: Samples of a minibatch.
        weight: Weight of the mean over a minibatch, in losses and gradients: this rank's share of all ranks' samples.
        config: Has the weights of the loss, and the limits of the standard deviation.
    """

    def __init__(self, actor: MLPModel | PixelModel, samples: int, weight: float, config: PPOConfig) -> None:
        assert isinstance(actor.distribution, GaussianDistribution)
        self._learnt, self._limits = actor.distribution.std_param, config.std_limits
        coefficients = config.clip, config.clip_values, config.value_loss_coef, config.entropy_coef
        self._numbers = (*coefficients, weight / samples)
        self.std = torch.zeros_like(self._learnt)
        """The standard deviation of the rollout, shape (actions,)."""
        device, actions = self.std.device, len(self.std)
        self._mean_gradient = torch.zeros(samples, actions, device=device)
        self._value_gradient = torch.zeros(samples, 1, device=device)
        self._terms = torch.zeros(samples, len(LOSSES) + actions, device=device)
        self._ones = torch.ones(samples, device=device)
        self.clipped = torch.zeros(samples, device=device)
        """Numbers that sum to the count of ratios beyond the clip range, since they were last set to 0."""

    def begin(self) -> None:
        """Store, before the first step of a rollout, the values that stay constant in it."""
        self.std.copy_(self._learnt.detach())

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Fill ``out``, shape (worlds, actions), with actions drawn by the network's ``outputs``."""
        return draws.normal(step, outputs, self.std, out)

    def log_prob(self, rollout: RolloutBuffer) -> torch.Tensor:
        """Log-probability of the rollout's actions, shape (steps, worlds)."""
        distance = (rollout.actions - rollout.outputs) / self.std
        return -(0.5 * distance.square() + self.std.log() + _LOG_ROOT_TWO_PI).sum(-1)

    def backward(
        self, rows: torch.Tensor, rollout: RolloutBuffer, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        """Add the gradient of the loss to the parameters behind ``outputs`` and ``values``.

        Args:
            rows: Samples of the minibatch in the flattened rollout, shape (samples,), int64.
            rollout: The rollout.
            outputs: Present outputs of the actor's network, shape (samples, outputs).
            values: Present values of the critic, shape (samples, 1).

        Returns:
            The weighted means of :data:`LOSSES`, shape (4,).
        """
        old = rollout.log_prob, rollout.advantages, rollout.returns, rollout.values
        read = (rollout.actions.flatten(0, 1), rollout.outputs.flatten(0, 1), *(each.flatten() for each in old))
        written = self._mean_gradient, self._value_gradient.view(-1), self._terms, self.clipped
        present = outputs, self._learnt, values.view(-1)
        arguments = (rows, *read, self.std, *present, *self._numbers, *written)
        launch(_objective, len(rows), arguments, str(rows.device))
        sums = torch.mv(self._terms.t(), self._ones)  # on a GPU faster than a reduction, and always in the same order
        gradients = self._mean_gradient, self._value_gradient, sums[len(LOSSES) :]
        torch.autograd.backward((outputs, values, self._learnt), gradients)
        return sums[: len(LOSSES)]

    def spread(self) -> torch.Tensor:
        """Mean standard deviation of the actions of the last rollout, shape (); 0 for choices."""
        return self.std.mean()

    @torch.no_grad()
    def project(self) -> None:
        """After a step of the optimizer: bring the standard deviation back into its limits."""
        # not a clamp in the forward pass: beyond its limits that has no gradient, and the deviation would stay there for ever
        self._learnt.clamp_(*self._limits)


class Categorical:
    """Actions are choices; the outputs are their logits. The methods are those of :class:`Gaussian`."""

    def __init__(self, weight: float, config: PPOConfig, device: str) -> None:
        self._weight, self._config = weight, config
        self._none = torch.zeros((), device=device)
        self.clipped = torch.zeros(1, device=device)

    def begin(self) -> None:
        pass

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        return draws.choices(step, outputs, out)

    def log_prob(self, rollout: RolloutBuffer) -> torch.Tensor:
        return torch.log_softmax(rollout.outputs, -1).gather(-1, rollout.actions.long()).squeeze(-1)

    def backward(
        self, rows: torch.Tensor, rollout: RolloutBuffer, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        choices, logits = rollout.actions.flatten(0, 1)[rows].long(), rollout.outputs.flatten(0, 1)[rows]
        log, old = torch.log_softmax(outputs, 1), torch.log_softmax(logits, 1)
        log_prob = log.gather(1, choices).squeeze(1)
        known = rollout.log_prob, rollout.advantages, rollout.returns, rollout.values
        samples = Samples(*(each.flatten()[rows] for each in known))
        entropy, kl = -(log.exp() * log).sum(1), (old.exp() * (old - log)).sum(1)
        loss, losses = clipped_loss(self._config, samples, log_prob, entropy, kl, values.squeeze(1))
        ratio = (log_prob.detach() - samples.log_prob).exp()
        self.clipped.add_(((ratio - 1.0).abs() > self._config.clip).sum())
        (self._weight * loss).backward()
        return self._weight * losses

    def spread(self) -> torch.Tensor:
        return self._none

    def project(self) -> None:
        pass


class Samples(NamedTuple):
    """The rollout's values for the samples of a minibatch, each of shape (samples,)."""

    log_prob: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor
    values: torch.Tensor


def clipped_loss(
    config: PPOConfig,
    samples: Samples,
    log_prob: torch.Tensor,
    entropy: torch.Tensor,
    kl: torch.Tensor,
    values: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The clipped objective (Schulman et al. 2017, arXiv:1707.06347, eq. 7 and 9) with rsl-rl's clipped value loss.

    Args:
        config: Has the clip range and the weights of the loss.
        samples: The rollout's values.
        log_prob, entropy, kl, values: Of the present policy and critic, shape (samples,).

    Returns:
        The loss, shape (), and the means of :data:`LOSSES`, shape (4,), without gradient.
    """
    ratio = (log_prob - samples.log_prob).exp()
    clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
    surrogate = torch.maximum(-samples.advantages * ratio, -samples.advantages * clipped).mean()
    error = (values - samples.returns).square()
    if config.clip_values:
        near = samples.values + (values - samples.values).clamp(-config.clip, config.clip)
        error = torch.maximum(error, (near - samples.returns).square())
    value, spread = error.mean(), entropy.mean()
    loss = surrogate + config.value_loss_coef * value - config.entropy_coef * spread
    return loss, torch.stack((surrogate, value, spread, kl.mean())).detach()
