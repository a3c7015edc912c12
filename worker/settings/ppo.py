"""Settings of the fused PPO, under ``train.ppo`` in a job's YAML. Imported without torch."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

Count = Annotated[int, Field(ge=1)]
Counts = Annotated[tuple[Count, ...], Field(min_length=1, strict=False)]  # YAML has lists
Activation = Literal[
    "elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish", "identity"
]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True))
class PPOConfig:
    """Proximal policy optimisation for one task. A shipped task names only the settings that differ from these, with images or without.

    Raises:
        ValueError: A value has the wrong type or is out of range; the message names the field.
    """

    steps: Count = 32
    """Control steps of every world in one iteration."""
    hidden_sizes: Counts = (64, 64)
    """Widths of the hidden layers of the actor, and of the critic unless it has its own."""
    critic_hidden_sizes: Counts | None = None
    """Widths of the critic's hidden layers; None: those of the actor."""
    critic_observations: Literal["policy", "critic"] = "policy"
    """Observation group of the critic: the policy's, or privileged observations with their own normaliser."""
    channels: Counts = (16, 32, 32)
    """Channels of the convolutions for image observations; a critic that sees the same images shares them."""
    kernel_sizes: Counts = (8, 4, 3)
    """Width and height of their kernels [px]."""
    strides: Counts = (4, 2, 1)
    """Their strides [px]."""
    activation: Activation = "elu"
    """Activation between layers."""
    epochs: Count = 5
    """Passes over the collected batch in one iteration."""
    minibatches: Count = 4
    """Parts into which each pass splits the batch: each has equally many steps of every world, so there are at most ``steps``."""
    learning_rate: Positive = 1.0e-3
    """Learning rate of the optimizer (the initial one of an adaptive schedule)."""
    learning_rate_limits: Annotated[tuple[Positive, Positive], Field(strict=False)] = (1.0e-5, 1.0e-2)
    """Least and greatest learning rate of the adaptive schedule."""
    learning_rate_horizon: Count | None = 100
    """Iterations for which the adaptive rate may reach its greatest value; that value then falls in inverse proportion to the iteration,
    so that a policy that has learnt is no longer changed by large steps. None: it never falls."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """``"adaptive"``: the learning rate follows the KL divergence; ``"fixed"``: it stays constant."""
    desired_kl: Positive = 0.01
    """Target of the adaptive schedule for the KL divergence between old and new policy [nat]."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """Adam, or AdamW with :attr:`weight_decay`."""
    weight_decay: Weight = 0.0
    """Decay of the weights in each step of AdamW, in units of the learning rate."""
    gamma: Fraction = 0.99
    """Discount of the reward per control step."""
    lam: Fraction = 0.95
    """Decay of generalised advantage estimation per control step."""
    clip: Positive = 0.2
    """Clip range of the probability ratio and of the value's change."""
    clip_values: bool = True
    """Whether the value's change is clipped."""
    entropy_coef: Weight = 0.0
    """Weight of the entropy bonus in the loss."""
    value_loss_coef: Weight = 1.0
    """Weight of the value loss in the loss."""
    max_grad_norm: Positive = 1.0
    """Norm to which the gradients of actor and critic are clipped, each separately."""
    init_std: Positive = 1.0
    """Initial standard deviation of the actions [unit of the action]; unused for choices."""
    min_std: Positive = 0.1
    """Least standard deviation of the actions [unit of the action], or :attr:`init_std` if that is smaller. Without it the deviation of an
    easy task falls until the policy explores nothing, and can't follow when its observations or their statistics change."""
    max_std: Positive = 1.0
    """Greatest standard deviation of the actions [unit of the action], or :attr:`init_std` if that is greater. Without it an entropy bonus
    raises the deviation of actions that are clipped at the ends of their range, where more noise costs nothing."""
    normalize_observations: bool = True
    """Whether observations are normalised by their running mean and variance; images never are."""
    normalizer_horizon: Count | None = None
    """Iterations after which the mean and variance of the observations stay as they are; None: they are always updated."""

    fixed: ClassVar[tuple[str, ...]] = (
        *("hidden_sizes", "critic_hidden_sizes", "critic_observations", "activation", "normalize_observations"),
        *("init_std", "channels", "kernel_sizes", "strides", "optimizer"),
    )
    """Settings that a resumed run can't change, since its checkpoints depend on them."""
    clone_may_change: ClassVar[tuple[str, ...]] = ("optimizer",)
    """Those of :attr:`fixed` that a clone can change, since it takes over only weights and normalisers."""
    before: ClassVar[dict[str, Any]] = {
        "learning_rate_horizon": None,
        "min_std": 1.0e-6,
        "max_std": 1.0e6,
        "normalizer_horizon": None,
    }
    """What runs computed that began before these settings existed."""
    elsewhere: ClassVar[dict[str, str]] = {
        **dict.fromkeys(
            ("rnd_cfg", "symmetry_cfg", "rnn_type", "rnn_hidden_dim", "class_name", "distribution_cfg"),
            "algorithm rsl_rl has it",
        ),
        **dict.fromkeys(("replay", "capacity", "batch_size", "tau", "updates"), "algorithm sac has it"),
    }
    """Settings of other algorithms that people look for here, and where to find them."""

    @model_validator(mode="after")
    def _agree(self) -> PPOConfig:
        if len({len(self.channels), len(self.kernel_sizes), len(self.strides)}) > 1:
            raise ValueError("channels, kernel_sizes and strides: give one number of each for every convolution")
        if self.minibatches > self.steps:
            raise ValueError(
                f"minibatches: {self.minibatches} minibatches need as many steps of each world, there are {self.steps}"
            )
        if self.learning_rate_limits[0] > self.learning_rate_limits[1]:
            raise ValueError("learning_rate_limits: expected the least, then the greatest")
        if self.min_std > self.max_std:
            raise ValueError(f"min_std: expected at most max_std ({self.max_std:g}), got {self.min_std:g}")
        if self.weight_decay and self.optimizer != "adamw":
            raise ValueError("weight_decay: adam has none; set optimizer: adamw")
        return self

    @property
    def std_limits(self) -> tuple[float, float]:
        """Least and greatest standard deviation of the actions."""
        return min(self.min_std, self.init_std), max(self.max_std, self.init_std)

    def greatest_rate(self, iteration: int) -> float:
        """The upper limit of the adaptive learning rate in an iteration, counted from 0."""
        least, greatest = self.learning_rate_limits
        if self.learning_rate_horizon is None or iteration < self.learning_rate_horizon:
            return greatest
        return max(least, greatest * self.learning_rate_horizon / (iteration + 1))

    def normalizer_learns(self, iteration: int) -> bool:
        """Whether the iteration's observations, counted from 0, enter the normalisers."""
        return self.normalizer_horizon is None or iteration < self.normalizer_horizon
