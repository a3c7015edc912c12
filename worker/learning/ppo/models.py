"""The networks: rsl-rl's models, with the image's bytes made into numbers inside."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.models.cnn_model import CNNModel
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import nn

if TYPE_CHECKING:
    from worker.learning.ppo.settings import PPOConfig

GROUP = "policy"
"""Name of the one observation group."""


class PixelModel(CNNModel):
    """rsl-rl's CNN model for images of bytes alone."""

    def get_latent(self, obs: Any, masks: torch.Tensor | None = None, hidden_state: Any = None) -> torch.Tensor:
        """What the convolutions make of images, shape (batch, channels, height, width), uint8: shape (batch, features)."""
        # the bytes are few: bring them into the order that convolutions are fastest with before they become numbers
        return self.cnns[GROUP](to_numbers(obs[GROUP].contiguous(memory_format=torch.channels_last)))

    def as_onnx(self, verbose: bool = False) -> nn.Module:
        """The mean action for images of bytes."""
        return _PixelPolicy(self)


class _PixelPolicy(nn.Module):
    """The policy as one module with one input, as it is exported."""

    input_names, output_names = ["obs"], ["actions"]

    def __init__(self, model: PixelModel) -> None:
        super().__init__()
        self.cnn, self.mlp = model.cnns[GROUP], model.mlp
        self._shape = (model.obs_channels_2d[0], *model.obs_dims_2d[0])

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.mlp(self.cnn(to_numbers(obs)))

    def get_dummy_inputs(self) -> tuple[torch.Tensor]:
        return (torch.zeros(1, *self._shape, dtype=torch.uint8),)


def to_numbers(images: torch.Tensor) -> torch.Tensor:
    """Bytes from 0 to 255 as float32 from -0.5 to 0.5."""
    return images.to(torch.float32) / 255.0 - 0.5


def build_models(
    config: PPOConfig, observation_shape: Sequence[int], action_size: int
) -> tuple[MLPModel | PixelModel, MLPModel | PixelModel]:
    """Actor, a Gaussian with its own learnt deviation, and critic.

    For vectors two MLPs over one shared observation normaliser; for images two MLPs over one shared stack of convolutions.
    """
    example = example_observations(1, observation_shape, "cpu")
    groups = {"actor": [GROUP], "critic": [GROUP]}
    common = {"hidden_dims": tuple(config.hidden_sizes), "activation": config.activation}
    distribution = {"class_name": GaussianDistribution, "init_std": config.init_std}
    if len(observation_shape) == 1:
        common["obs_normalization"] = config.normalize_observations
        actor = MLPModel(example, groups, "actor", action_size, distribution_cfg=distribution, **common)
        critic = MLPModel(example, groups, "critic", 1, **common)
        critic.obs_normalizer = actor.obs_normalizer  # both see the same observations: keep one set of moments
        return actor, critic
    _check_layers(config, observation_shape)
    layers = {
        "output_channels": list(config.channels),
        "kernel_size": list(config.kernel_sizes),
        "stride": list(config.strides),
        "activation": config.activation,
    }
    seeing = PixelModel(example, groups, "actor", action_size, distribution_cfg=distribution, cnn_cfg=layers, **common)
    with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl says that they are shared
        judging = PixelModel(example, groups, "critic", 1, cnns=seeing.cnns, **common)
    return seeing, judging


def _check_layers(config: PPOConfig, shape: Sequence[int]) -> None:
    """Raises ValueError for a convolution that leaves nothing of an image."""
    height, width = shape[1:]
    for number, (kernel, stride) in enumerate(zip(config.kernel_sizes, config.strides, strict=True), start=1):
        if kernel > min(height, width):
            raise ValueError(
                f"ppo: convolution {number} has a kernel of {kernel} and a stride of {stride}, but {width} x {height} px are left of "
                f"the image of {shape[2]} x {shape[1]}; change kernel_sizes and strides, or the camera's size"
            )
        height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1


def example_observations(worlds: int, shape: Sequence[int], device: str) -> TensorDict:
    """Zeros in the form in which rsl-rl's constructors want observations: shape (worlds, *shape), images as bytes."""
    dtype = torch.float32 if len(shape) == 1 else torch.uint8
    zeros = torch.zeros(worlds, *shape, device=device, dtype=dtype)
    return TensorDict({GROUP: zeros}, batch_size=[worlds], device=device)
