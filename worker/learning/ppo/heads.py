"""Interpretations of the actor's outputs: how actions are drawn from them, and the gradient of the loss."""

from __future__ import annotations

from typing import Protocol

import torch
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution

from worker.learning.ppo.draws import Draws
from worker.learning.ppo.loss import Clipping, Samples, categorical_terms, clipped_loss, gaussian_terms
from worker.learning.ppo.models import PixelModel
from worker.learning.ppo.objective import Objective
from worker.learning.ppo.rollout import Rollout


class Head(Protocol):
    """Interpretation of one actor's outputs, for minibatches of one size."""

    def begin(self) -> None:
        """Store, before the first step of a rollout, the values that stay constant in it."""

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Fill ``out``, shape (worlds, actions), with actions drawn by the network's ``outputs``."""

    def log_prob(self, rollout: Rollout) -> torch.Tensor:
        """Log-probability of the rollout's actions, shape (steps, worlds)."""

    def backward(
        self, rows: torch.Tensor, rollout: Rollout, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        """Add the gradient of the loss to the parameters behind ``outputs`` and ``values``.

        Args:
            rows: Samples of the minibatch in the flattened rollout, shape (samples,), int64.
            outputs: Present outputs of the actor's network, shape (samples, outputs).
            values: Present values of the critic, shape (samples, 1).

        Returns:
            The weighted means of :data:`worker.learning.ppo.loss.LOSSES`, shape (4,).
        """

    def spread(self) -> torch.Tensor:
        """Mean standard deviation of the actions of the last rollout, shape (); 0 for choices."""


class Gaussian:
    """Actions are normal around the outputs, with a learnt standard deviation each.

    ``plain`` uses the loss in torch instead of the equivalent, faster kernel of :mod:`worker.learning.ppo.objective`.
    """

    def __init__(
        self,
        actor: MLPModel | PixelModel,
        actions: int,
        samples: int,
        device: str,
        *,
        weight: float,
        settings: Clipping,
        plain: bool = False,
    ) -> None:
        assert isinstance(actor.distribution, GaussianDistribution)
        self._distribution, self._weight, self._settings = actor.distribution, weight, settings
        self.std = torch.zeros(actions, device=device)
        """The standard deviation of the rollout."""
        self._objective = None if plain else Objective(samples, actions, device, weight=weight, settings=settings)

    def begin(self) -> None:
        with torch.no_grad():
            self.std.copy_(self._std())

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        return draws.normal(step, outputs, self.std, out)

    def log_prob(self, rollout: Rollout) -> torch.Tensor:
        flat = rollout.outputs.flatten(0, 1)
        return gaussian_terms(rollout.actions.flatten(0, 1), flat, self.std, flat, self.std)[0].view_as(rollout.values)

    def backward(
        self, rows: torch.Tensor, rollout: Rollout, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        actions, means = rollout.actions.flatten(0, 1), rollout.outputs.flatten(0, 1)
        if self._objective is not None:
            told = (rollout.log_prob, rollout.advantages, rollout.returns, rollout.values)
            flat = (actions, means, *(each.flatten() for each in told))
            return self._objective.backward(rows, flat, self.std, outputs, self._std(), values)
        terms = gaussian_terms(actions[rows], means[rows], self.std, outputs, self._std())
        return _backward(self._settings, self._weight, rows, rollout, terms, values)

    def spread(self) -> torch.Tensor:
        return self.std.mean()

    def _std(self) -> torch.Tensor:
        least, greatest = self._distribution.std_range
        return self._distribution.std_param.clamp(least, greatest)


class Categorical:
    """Actions are choices; the outputs are their logits."""

    def __init__(self, *, weight: float, settings: Clipping, device: str) -> None:
        self._weight, self._settings = weight, settings
        self._none = torch.zeros((), device=device)

    def begin(self) -> None:
        pass

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        return draws.choices(step, outputs, out)

    def log_prob(self, rollout: Rollout) -> torch.Tensor:
        flat = rollout.outputs.flatten(0, 1)
        return categorical_terms(rollout.actions.flatten(0, 1), flat, flat)[0].view_as(rollout.values)

    def backward(
        self, rows: torch.Tensor, rollout: Rollout, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        actions, logits = rollout.actions.flatten(0, 1), rollout.outputs.flatten(0, 1)
        terms = categorical_terms(actions[rows], logits[rows], outputs)
        return _backward(self._settings, self._weight, rows, rollout, terms, values)

    def spread(self) -> torch.Tensor:
        return self._none


def _backward(
    settings: Clipping,
    weight: float,
    rows: torch.Tensor,
    rollout: Rollout,
    terms: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    values: torch.Tensor,
) -> torch.Tensor:
    told = (rollout.log_prob, rollout.advantages, rollout.returns, rollout.values)
    samples = Samples(*(each.flatten()[rows] for each in told))
    loss, losses = clipped_loss(settings, samples, *terms, values.squeeze(1))
    (weight * loss).backward()
    return weight * losses
