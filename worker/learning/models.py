"""The networks: rsl-rl's models as they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

if TYPE_CHECKING:
    from worker.tasks.config import PPOConfig

GROUP = "policy"
"""Name of the one observation group."""


def build_models(config: PPOConfig, observation_size: int, action_size: int) -> tuple[MLPModel, MLPModel]:
    """Actor and critic: two MLPs over one shared observation normaliser; the actor a Gaussian with its own learnt deviation."""
    example = example_observations(1, observation_size, "cpu")
    groups = {"actor": [GROUP], "critic": [GROUP]}
    common = {
        "hidden_dims": tuple(config.hidden_sizes),
        "activation": config.activation,
        "obs_normalization": config.normalize_observations,
    }
    distribution = {"class_name": GaussianDistribution, "init_std": config.init_std}
    actor = MLPModel(example, groups, "actor", action_size, distribution_cfg=distribution, **common)
    critic = MLPModel(example, groups, "critic", 1, **common)
    critic.obs_normalizer = actor.obs_normalizer  # both see the same observations: keep one set of moments
    return actor, critic


def example_observations(worlds: int, size: int, device: str) -> TensorDict:
    """Zeros in the form in which rsl-rl's constructors want observations: shape (worlds, size)."""
    return TensorDict({GROUP: torch.zeros(worlds, size, device=device)}, batch_size=[worlds], device=device)
