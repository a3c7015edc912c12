"""PPO's clipped loss in plain torch, for any distribution of actions."""

from __future__ import annotations

from dataclasses import dataclass

import torch

LOSSES = ("surrogate_loss", "value_loss", "entropy", "kl")
"""Names of the metrics of every minibatch."""


@dataclass(frozen=True)
class Clipping:
    """The weights of the loss."""

    clip: float
    """Ratios are clipped to 1 ± ``clip``, values to the old ones ± ``clip``."""
    clip_values: bool
    """Whether the change of the value is clipped."""
    value_coef: float
    entropy_coef: float


@dataclass(frozen=True)
class Samples:
    """The rollout's values for the samples of a minibatch, each of shape (samples,)."""

    log_prob: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor
    values: torch.Tensor


def clipped_loss(
    settings: Clipping,
    samples: Samples,
    log_prob: torch.Tensor,
    entropy: torch.Tensor,
    kl: torch.Tensor,
    values: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The clipped objective (Schulman et al. 2017, arXiv:1707.06347, eq. 7 and 9) with rsl-rl's clipped value loss.

    Args:
        samples: The rollout's values.
        log_prob, entropy, kl, values: Of the present policy and critic, shape (samples,).

    Returns:
        The loss, shape (), and the means of :data:`LOSSES`, shape (4,), without gradient.
    """
    ratio = (log_prob - samples.log_prob).exp()
    clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
    surrogate = torch.maximum(-samples.advantages * ratio, -samples.advantages * clipped).mean()
    error = (values - samples.returns).square()
    if settings.clip_values:
        near = samples.values + (values - samples.values).clamp(-settings.clip, settings.clip)
        error = torch.maximum(error, (near - samples.returns).square())
    value, spread = error.mean(), entropy.mean()
    loss = surrogate + settings.value_coef * value - settings.entropy_coef * spread
    return loss, torch.stack((surrogate, value, spread, kl.mean())).detach()


def is_clipped(settings: Clipping, samples: Samples, log_prob: torch.Tensor) -> torch.Tensor:
    """Whether the probability ratio of each sample is beyond the clip range; shape (samples,), bool."""
    return ((log_prob - samples.log_prob).exp() - 1.0).abs() > settings.clip


def gaussian_terms(
    actions: torch.Tensor, old_mean: torch.Tensor, old_std: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Log-probability of the actions, entropy, and KL(old ‖ new) of diagonal Gaussians, each of shape (samples,).

    Args:
        actions, old_mean, mean: Shape (samples, actions).
        old_std, std: Shape (actions,).
    """
    log_std = std.log()
    half_log_two_pi = 0.9189385332046727
    log_prob = -(0.5 * ((actions - mean) / std).square() + log_std + half_log_two_pi).sum(1)
    entropy = (0.5 + half_log_two_pi + log_std).sum().expand(len(mean))
    ratio = (old_std / std).square()
    kl = (0.5 * (ratio + ((old_mean - mean) / std).square() - 1.0) - (old_std / std).log()).sum(1)
    return log_prob, entropy, kl


def categorical_terms(
    actions: torch.Tensor, old_logits: torch.Tensor, logits: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Log-probability of the choices, entropy, and KL(old ‖ new), each of shape (samples,).

    Args:
        actions: The choices, shape (samples, 1), float32.
        old_logits, logits: Shape (samples, choices).
    """
    log, old = torch.log_softmax(logits, 1), torch.log_softmax(old_logits, 1)
    log_prob = log.gather(1, actions.long()).squeeze(1)
    return log_prob, -(log.exp() * log).sum(1), (old.exp() * (old - log)).sum(1)
