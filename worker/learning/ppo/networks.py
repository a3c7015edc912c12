"""The networks: rsl-rl's models, which also convert image bytes to floats, and the policy made from the actor."""

from __future__ import annotations

import contextlib
import copy
import io
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.models.cnn_model import CNNModel
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import nn

from worker.learning.algorithm import POLICY, ExportedPolicy, Spaces
from worker.learning.observations import synthetic, to_numbers
from worker.settings.ppo import PPOConfig


class PixelModel(CNNModel):
    """rsl-rl's CNN model for byte images only."""

    def get_latent(self, obs: Any, masks: torch.Tensor | None = None, hidden_state: Any = None) -> torch.Tensor:
        """Features, shape (batch, features), of images, shape (batch, channels, height, width), uint8."""
        # bytes are small: bring them into the fastest memory order for convolutions before they become floats
        images = obs[POLICY].contiguous(memory_format=torch.channels_last)
        features: torch.Tensor = self.cnns[POLICY](to_numbers(images))
        return features


class ActorPolicy:
    """The mean action, or for a task with choices the likeliest, from only the actor's network."""

    def __init__(self, actor: MLPModel | PixelModel, spaces: Spaces) -> None:
        self.actor, self._spaces = actor, spaces

    @torch.no_grad()
    def act(self, observations: TensorDict | Mapping[str, torch.Tensor]) -> torch.Tensor:
        seen: Any = {POLICY: observations[POLICY]}  # rsl-rl only looks its groups up
        outputs: torch.Tensor = self.actor.mlp(self.actor.get_latent(seen))
        return outputs.argmax(1, keepdim=True).to(torch.float32) if self._spaces.discrete else outputs

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """No-op: the policy has no recurrent state."""

    def state_dict(self) -> dict[str, Any]:
        return dict(self.actor.state_dict())

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        return self.actor.load_state_dict(state)

    def module(self) -> ExportedPolicy:
        actor = copy.deepcopy(self.actor).cpu().eval()
        network = _Network(actor, self._spaces.discrete).eval()
        sample = synthetic({POLICY: self._spaces.observations[POLICY]}, getattr(actor, "obs_normalizer", None))
        return ExportedPolicy(network, {"obs": sample[POLICY][:1]}, ["actions"], sample)


class _Network(nn.Module):
    """The policy as one module with one input for the export; it includes the normaliser, or the conversion to floats."""

    def __init__(self, actor: MLPModel | PixelModel, discrete: bool) -> None:
        super().__init__()
        self.mlp, self._discrete, self._sees_images = actor.mlp, discrete, isinstance(actor, PixelModel)
        self.before = actor.cnns[POLICY] if isinstance(actor, PixelModel) else actor.obs_normalizer

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        outputs: torch.Tensor = self.mlp(self.before(to_numbers(obs) if self._sees_images else obs))
        return outputs.argmax(1, keepdim=True).to(torch.float32) if self._discrete else outputs


def build_actor(config: PPOConfig, spaces: Spaces) -> MLPModel | PixelModel:
    """A network for the group ``policy``. Its outputs are logits, or the mean of a Gaussian with a learnt standard deviation."""
    example = spaces.example(1, "cpu")
    common: dict[str, Any] = {"hidden_dims": config.hidden_sizes, "activation": config.activation}
    if not spaces.discrete:
        common["distribution_cfg"] = {"class_name": GaussianDistribution, "init_std": config.init_std}
    shape = spaces.observations[POLICY]
    groups = {"actor": [POLICY]}
    if len(shape) == 1:
        common["obs_normalization"] = config.normalize_observations
        return MLPModel(example, groups, "actor", spaces.actions, **common)
    _check_layers(config, shape)
    layers = {
        "output_channels": list(config.channels),
        "kernel_size": list(config.kernel_sizes),
        "stride": list(config.strides),
        "activation": config.activation,
    }
    return PixelModel(example, groups, "actor", spaces.actions, cnn_cfg=layers, **common)


def build_critic(config: PPOConfig, spaces: Spaces, actor: MLPModel | PixelModel) -> MLPModel | PixelModel:
    """A network whose output is a value. With the actor's observations, it shares the actor's normaliser or convolutions.

    Raises ValueError if the task lacks the group, or if it holds images that the policy does not see.
    """
    group = config.critic_observations
    if group not in spaces.observations:
        raise ValueError(
            f"critic_observations: the task has no group {group!r}; it has {', '.join(spaces.observations)}"
        )
    example = spaces.example(1, "cpu")
    sizes = config.critic_hidden_sizes or config.hidden_sizes
    common: dict[str, Any] = {"hidden_dims": sizes, "activation": config.activation}
    groups: dict[str, list[str]] = {"critic": [group]}
    if isinstance(actor, PixelModel) and group == POLICY:
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints that they are shared
            return PixelModel(example, groups, "critic", 1, cnns=actor.cnns, **common)
    if len(spaces.observations[group]) > 1:
        raise ValueError(
            f"critic_observations: {group!r} is a group of images that the policy does not see; rsl_rl can do that"
        )
    critic = MLPModel(example, groups, "critic", 1, obs_normalization=config.normalize_observations, **common)
    if group == POLICY:
        critic.obs_normalizer = actor.obs_normalizer  # both see the same observations: keep one set of moments
    return critic


def _check_layers(config: PPOConfig, shape: Sequence[int]) -> None:
    """Raises ValueError for a convolution whose output would be empty."""
    height, width = shape[1:]
    for number, (kernel, stride) in enumerate(zip(config.kernel_sizes, config.strides, strict=True), start=1):
        if kernel > min(height, width):
            raise ValueError(
                f"ppo: convolution {number} has a kernel of {kernel} and a stride of {stride}, but {width} x {height} px are left of "
                f"the image of {shape[2]} x {shape[1]}; change kernel_sizes and strides, or the camera's size"
            )
        height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
