"""Settings of the fused PPO."""

from __future__ import annotations

import math
from dataclasses import dataclass

ACTIVATIONS = (
    *("elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish", "identity"),
)
"""Names of activations that rsl-rl's networks know."""
SCHEDULES = ("adaptive", "fixed")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation for one task.

    Raises:
        ValueError: A value has the wrong type or is out of range; the message names the field.
    """

    steps: int = 32
    """Control steps of every world in one iteration."""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    channels: tuple[int, ...] = (16, 32, 32)
    """Channels of the convolutions that actor and critic share, where observations are images."""
    kernel_sizes: tuple[int, ...] = (8, 4, 3)
    """Width and height of their kernels [px]."""
    strides: tuple[int, ...] = (4, 2, 1)
    """Their strides [px]."""
    activation: str = "elu"
    """Activation between layers, one of :data:`ACTIVATIONS`."""
    epochs: int = 5
    """Passes over the collected batch in one iteration."""
    minibatches: int = 4
    """Parts into which each pass splits the batch."""
    learning_rate: float = 1.0e-3
    """Step size of Adam (the first one, where the schedule adapts it)."""
    schedule: str = "adaptive"
    """``"adaptive"``: the learning rate follows the KL divergence; ``"fixed"``: it stays."""
    desired_kl: float = 0.01
    """KL divergence between old and new policy that the adaptive schedule aims at [nat]."""
    gamma: float = 0.99
    """Discount of the reward per control step."""
    lam: float = 0.95
    """Decay of generalised advantage estimation per control step."""
    clip: float = 0.2
    """Clip range of the probability ratio and of the value's change."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus in the loss."""
    value_loss_coef: float = 1.0
    """Weight of the value loss in the loss."""
    max_grad_norm: float = 1.0
    """Norm to which gradients are clipped."""
    init_std: float = 1.0
    """Initial standard deviation of the actions [unit of the action]."""
    normalize_observations: bool = True
    """Whether observations are normalised by their running mean and variance; images never are."""

    def __post_init__(self) -> None:
        for name in ("steps", "epochs", "minibatches"):
            if not _is_count(value := getattr(self, name)):
                raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}")
        for name in ("hidden_sizes", "channels", "kernel_sizes", "strides"):
            value = getattr(self, name)
            if not isinstance(value, list | tuple) or not value or not all(map(_is_count, value)):
                shown = list(value) if isinstance(value, tuple) else value
                raise ValueError(f"{name}: expected a list of whole numbers of at least 1, got {shown!r}")
            object.__setattr__(self, name, tuple(value))
        if len({len(self.channels), len(self.kernel_sizes), len(self.strides)}) > 1:
            raise ValueError("channels, kernel_sizes and strides: give one number of each for every convolution")
        for name, known in (("activation", ACTIVATIONS), ("schedule", SCHEDULES)):
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"{name}: expected one of {', '.join(known)}; got {value!r}")
        for name, least, most, words in _PPO_NUMBERS:
            value = getattr(self, name)
            if not _is_finite(value) or not least <= value <= most:
                raise ValueError(f"{name}: expected a number {words}, got {value!r}")
            object.__setattr__(self, name, float(value))
        if not isinstance(self.normalize_observations, bool):
            raise ValueError(f"normalize_observations: expected true or false, got {self.normalize_observations!r}")


_LEAST = math.nextafter(0.0, 1.0)
_PPO_NUMBERS = (
    *((name, _LEAST, math.inf, "above 0") for name in ("learning_rate", "desired_kl", "clip", "max_grad_norm")),
    ("init_std", _LEAST, math.inf, "above 0"),
    *((name, 0.0, 1.0, "from 0 to 1") for name in ("gamma", "lam")),
    *((name, 0.0, math.inf, "of 0 or more") for name in ("entropy_coef", "value_loss_coef")),
)
"""Numbers of :class:`PPOConfig`: name, least, greatest, and the range in words."""


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
