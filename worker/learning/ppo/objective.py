"""PPO's clipped objective and its gradient, computed in one kernel instead of a hundred small ones."""

from __future__ import annotations

import torch
import warp as wp

from worker.learning.ppo.loss import LOSSES, Clipping
from worker.simulation.capture import on_torch_stream

_HALF_LOG_TWO_PI = wp.constant(0.9189385332046727)


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
    """One sample; columns of ``terms`` are :data:`LOSSES`, then the gradient of each component of the deviation. Ratios beyond the clip
    range are counted. Comparisons are such that NaN, which none of them holds for, goes on into losses and gradients."""
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


class Objective:
    """:func:`worker.learning.ppo.loss.clipped_loss` of a diagonal Gaussian, for minibatches of one size.

    Args:
        samples: Samples of a minibatch.
        actions: Length of an action.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        weight: Weight of the mean over a minibatch, in losses and gradients: this rank's share of all ranks' samples.
        settings: The weights of the loss.
    """

    def __init__(self, samples: int, actions: int, device: str, *, weight: float, settings: Clipping) -> None:
        wp.init()
        coefficients = settings.value_coef, settings.entropy_coef
        self._numbers = (settings.clip, settings.clip_values, *coefficients, weight / samples)
        self._device = device
        self._mean_gradient = torch.zeros(samples, actions, device=device)
        self._value_gradient = torch.zeros(samples, 1, device=device)
        self._terms = torch.zeros(samples, len(LOSSES) + actions, device=device)
        self._ones = torch.ones(samples, device=device)
        self.clipped = torch.zeros(samples, device=device)
        """Number of minibatches in which the ratio of the sample at this place was beyond the clip range; shape (samples,)."""

    def backward(
        self,
        rows: torch.Tensor,
        rollout: tuple[torch.Tensor, ...],
        old_std: torch.Tensor,
        mean: torch.Tensor,
        std: torch.Tensor,
        values: torch.Tensor,
    ) -> torch.Tensor:
        """Add the gradient to the parameters behind ``mean``, ``std`` and ``values``.

        Args:
            rows: Samples of the minibatch in the rollout, shape (samples,), int64.
            rollout: Values of all samples: actions and old means, shape (n, actions), old log-probabilities, advantages, returns and
                old values, shape (n,).
            old_std: The standard deviation of the rollout, shape (actions,).
            mean: Present mean of the policy for the minibatch, shape (samples, actions).
            std: Present standard deviation of the policy, shape (actions,).
            values: Present values of the critic, shape (samples, 1).

        Returns:
            The weighted means of :data:`worker.learning.ppo.loss.LOSSES`, shape (4,).
        """
        read = (rows, *rollout, old_std, mean.detach(), std.detach(), values.detach().view(-1))
        written = (self._mean_gradient, self._value_gradient.view(-1), self._terms, self.clipped)
        with on_torch_stream(self._device):
            wp.launch(
                _objective,
                dim=len(rows),
                inputs=[*(wp.from_torch(each, return_ctype=True) for each in read), *self._numbers],
                outputs=[wp.from_torch(each, return_ctype=True) for each in written],
                device=self._device,
            )
        sums = torch.mv(self._terms.t(), self._ones)  # on a GPU faster than a reduction, and always in the same order
        torch.autograd.backward((mean, values, std), (self._mean_gradient, self._value_gradient, sums[len(LOSSES) :]))
        return sums[: len(LOSSES)]
