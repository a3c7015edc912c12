"""The heads of the actor: how its outputs are interpreted, how actions are drawn from them, and the gradient of the loss."""

from __future__ import annotations

from typing import Protocol

import torch
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution

from worker.learning.ppo.draws import Draws
from worker.learning.ppo.loss import Clipping, Samples, categorical_terms, clipped_loss, gaussian_terms, is_clipped
from worker.learning.ppo.networks import PixelModel
from worker.learning.ppo.objective import Objective
from worker.learning.ppo.rollout_buffer import RolloutBuffer


class Head(Protocol):
    """Interpretation of one actor's outputs, for minibatches of one size."""

    def begin(self) -> None:
        """Store, before the first step of a rollout, the values that stay constant in it."""

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Fill ``out``, shape (worlds, actions), with actions drawn by the network's ``outputs``."""

    def log_prob(self, rollout: RolloutBuffer) -> torch.Tensor:
        """Log-probability of the rollout's actions, shape (steps, worlds)."""

    def backward(
        self, rows: torch.Tensor, rollout: RolloutBuffer, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        """Add the gradient of the loss to the parameters behind ``outputs`` and ``values``.

        Args:
            rows: Samples of the minibatch in the flattened rollout, shape (samples,), int64.
            outputs: Present outputs of the actor's network, shape (samples, outputs).
            values: Present values of the critic, shape (samples, 1).

        Returns:
            The weighted means of :data:`worker.learning.ppo.loss.LOSSES`, shape (4,).
        """

    @property
    def clipped(self) -> torch.Tensor:
        """Numbers that sum to the count of ratios beyond the clip range, since they were last set to 0."""

    def spread(self) -> torch.Tensor:
        """Mean standard deviation of the actions of the last rollout, shape (); 0 for choices."""

    def project(self) -> None:
        """After a step of the optimizer: bring the standard deviation back into its limits."""


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
        limits: tuple[float, float],
        plain: bool = False,
    ) -> None:
        """``limits``: least and greatest standard deviation."""
        assert isinstance(actor.distribution, GaussianDistribution)
        self._learnt, self._weight, self._settings = actor.distribution.std_param, weight, settings
        self._limits = limits
        self.std = torch.zeros(actions, device=device)
        """The standard deviation of the rollout."""
        self._objective = None if plain else Objective(samples, actions, device, weight=weight, settings=settings)
        self.clipped = self._objective.clipped if self._objective else torch.zeros(1, device=device)

    def begin(self) -> None:
        self.std.copy_(self._learnt.detach())

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        return draws.normal(step, outputs, self.std, out)

    def log_prob(self, rollout: RolloutBuffer) -> torch.Tensor:
        flat = rollout.outputs.flatten(0, 1)
        return gaussian_terms(rollout.actions.flatten(0, 1), flat, self.std, flat, self.std)[0].view_as(rollout.values)

    def backward(
        self, rows: torch.Tensor, rollout: RolloutBuffer, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        actions, means = rollout.actions.flatten(0, 1), rollout.outputs.flatten(0, 1)
        if self._objective is not None:
            told = (rollout.log_prob, rollout.advantages, rollout.returns, rollout.values)
            flat = (actions, means, *(each.flatten() for each in told))
            return self._objective.backward(rows, flat, self.std, outputs, self._learnt, values)
        terms = gaussian_terms(actions[rows], means[rows], self.std, outputs, self._learnt)
        return _backward(self, rows, rollout, terms, values)

    def spread(self) -> torch.Tensor:
        return self.std.mean()

    @torch.no_grad()
    def project(self) -> None:
        # not a clamp in the forward pass: beyond its limits that has no gradient, and the deviation would stay there for ever
        self._learnt.clamp_(*self._limits)


class Categorical:
    """Actions are choices; the outputs are their logits."""

    def __init__(self, *, weight: float, settings: Clipping, device: str) -> None:
        self._weight, self._settings = weight, settings
        self._none = torch.zeros((), device=device)
        self.clipped = torch.zeros(1, device=device)

    def begin(self) -> None:
        pass

    def draw(self, draws: Draws, step: int, outputs: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        return draws.choices(step, outputs, out)

    def log_prob(self, rollout: RolloutBuffer) -> torch.Tensor:
        flat = rollout.outputs.flatten(0, 1)
        return categorical_terms(rollout.actions.flatten(0, 1), flat, flat)[0].view_as(rollout.values)

    def backward(
        self, rows: torch.Tensor, rollout: RolloutBuffer, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        actions, logits = rollout.actions.flatten(0, 1), rollout.outputs.flatten(0, 1)
        terms = categorical_terms(actions[rows], logits[rows], outputs)
        return _backward(self, rows, rollout, terms, values)

    def spread(self) -> torch.Tensor:
        return self._none

    def project(self) -> None:
        pass


def _backward(
    head: Gaussian | Categorical,
    rows: torch.Tensor,
    rollout: RolloutBuffer,
    terms: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    values: torch.Tensor,
) -> torch.Tensor:
    told = (rollout.log_prob, rollout.advantages, rollout.returns, rollout.values)
    samples = Samples(*(each.flatten()[rows] for each in told))
    loss, losses = clipped_loss(head._settings, samples, *terms, values.squeeze(1))
    head.clipped.add_(is_clipped(head._settings, samples, terms[0].detach()).sum())
    (head._weight * loss).backward()
    return head._weight * losses
