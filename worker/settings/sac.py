"""Settings of SAC; importable without torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, Strict, model_validator
from pydantic.dataclasses import dataclass

LOG_STD = (-5.0, 0.0)
"""Bounds of the logarithm of the policy's standard deviation, before squashing (arXiv:2512.01996)."""

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0)]
Fraction = Annotated[float, Field(gt=0.0, le=1.0)]
Sizes = Annotated[tuple[Count, ...], Strict(False), Field(min_length=1)]
"""A list or tuple of counts, each strictly a whole number."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class SACConfig:
    """Soft actor-critic for one task.

    The defaults are close to those of FastSAC (arXiv:2512.01996), for thousands of worlds of a robot on a GPU. For a small task on a CPU,
    set smaller networks, a smaller batch and larger learning rates. For every task, set ``v_min`` and ``v_max`` to tight bounds of its
    discounted returns.

    Types are strict: neither ``true`` nor text is accepted as a number.

    Raises:
        pydantic.ValidationError: A ValueError that names the field.
    """

    steps: Count = 4
    """Control steps of every world in one iteration."""
    updates: Count = 16
    """Updates of the critics in one iteration; a multiple of ``policy_delay``."""
    policy_delay: Count = 2
    """The policy and the temperature learn once in this many updates of the critics."""
    batch_size: Count = 8192
    """Transitions of one update, over all ranks."""
    replay_steps: Count = 1024
    """Number of newest steps kept of every world, at least ``steps`` and ``n_step``.

    A step of a world costs ``4 · (2 · observations + actions + 3)`` bytes of the device's memory; if the critics have their own group,
    its observations count too. :mod:`worker.learning.sac.replay_buffer` says what is stored."""
    warm_up: Annotated[int, Field(ge=0)] = 8
    """Steps of every world that the replay must hold before learning starts; until the first update, actions are drawn uniformly within
    the limit."""
    save_replay: Literal[True, False, "auto"] = "auto"
    """Whether checkpoints hold the replay. Without it they are small, and a resumed run first fills a new one, so it doesn't continue as
    if it had never stopped. ``"auto"``: hold it if the replay of a rank is small, see :data:`worker.learning.sac.sac.SAVED`. With it, a
    GPU holds the replay twice from the first save on."""

    actor_sizes: Sizes = (512, 256, 128)
    """Widths of the hidden layers of the policy."""
    critic_sizes: Sizes = (768, 384, 192)
    """Widths of the hidden layers of each critic."""
    critics: Count = 2
    """Number of critics, each with its own initial weights."""
    layer_norm: bool = True
    """Whether each hidden layer of the policy and of the critics is normalised, which keeps frequently updated critics from diverging."""
    critic_group: str = "policy"
    """The observation group of the critics; ``critic`` has privileged observations without noise. The policy sees ``policy``."""
    normalize_observations: bool = True
    """Whether observations are normalised by their running mean and variance."""

    atoms: Count = 101
    """Number of values over which the critics predict a distribution of the return (arXiv:1707.06887); 1: they predict only its mean."""
    v_min: float = -20.0
    """The least of these values [discounted return]; not used with one atom."""
    v_max: float = 20.0
    """The greatest of these values [discounted return]; greater returns can't be distinguished from it."""
    combine: Literal["mean", "min"] = "mean"
    """Combination of the critics' predictions in targets and for the policy: ``"mean"``, or ``"min"``, the most cautious one."""

    gamma: Annotated[float, Field(ge=0.0, le=1.0)] = 0.97
    """Discount of the reward per control step; 0.97 looks half a second ahead at 50 Hz."""
    n_step: Count = 3
    """Number of rewards in a target before it bootstraps: more spread rewards faster, but come from older policies."""
    tau: Fraction = 0.125
    """Fraction by which the target critics move towards the critics in each update."""

    actor_learning_rate: Positive = 3.0e-4
    """Learning rate of AdamW for the policy."""
    critic_learning_rate: Positive = 3.0e-4
    """Learning rate of AdamW for the critics."""
    temperature_learning_rate: Positive = 3.0e-4
    """Learning rate of AdamW for the logarithm of the temperature."""
    weight_decay: Annotated[float, Field(ge=0.0)] = 1.0e-3
    """Weight decay of AdamW per step, times the learning rate; the temperature has none."""
    max_grad_norm: Annotated[float, Field(ge=0.0)] = 0.0
    """Norm to which the gradients of the critics, and of the policy, are clipped; 0: no clipping."""

    action_limit: Positive = 1.0
    """Actions are strictly within ± this [unit of the action]; tasks clip them at ± 1."""
    init_std: Annotated[float, Field(gt=math.exp(LOG_STD[0]), lt=math.exp(LOG_STD[1]))] = 0.5
    """Standard deviation of the first policy, before squashing [action limit]."""
    target_entropy: float = 0.0
    """Target entropy of each component of the action, on average [nat], in units of the action limit; 0 is that of a uniform choice from
    half the range, and −1 is usual for SAC (arXiv:1812.05905)."""
    init_temperature: Positive = 1.0e-3
    """Initial temperature: the value of the policy's entropy [reward per nat]."""

    fixed: ClassVar[tuple[str, ...]] = (
        *("actor_sizes", "critic_sizes", "critics", "layer_norm", "critic_group", "normalize_observations"),
        *("atoms", "v_min", "v_max", "replay_steps", "action_limit", "init_std", "init_temperature"),
    )
    """Settings that a resumed run can't change, since its checkpoints depend on them."""
    clone_may_change: ClassVar[tuple[str, ...]] = ("replay_steps", "init_temperature")
    """Those of :attr:`fixed` that a clone can change, since it takes over only weights and normalisers."""

    def check_observations(self, groups: Mapping[str, bool]) -> None:
        """Raises ValueError if the task lacks a group, or has images where numbers are expected.

        Args:
            groups: The task's groups, and whether each holds images.
        """
        if self.critic_group not in groups:
            known = ", ".join(groups)
            raise ValueError(f"critic_group: there is no observation group {self.critic_group!r}; available: {known}")
        if images := [group for group in ("policy", self.critic_group) if groups[group]]:
            raise ValueError(f"it can't learn from images, and observation group {images[0]!r} is one; use ppo")

    def check_actions(self, chooses: bool) -> None:
        """Raises ValueError for a task whose policy chooses one of several actions."""
        if chooses:
            raise ValueError("its actions are numbers from a range, and this task's are choices; use ppo")

    @model_validator(mode="after")
    def _fits(self) -> SACConfig:
        """Check fields against each other."""
        if self.updates % self.policy_delay:
            raise ValueError(f"updates: expected a multiple of policy_delay ({self.policy_delay}), got {self.updates}")
        if self.replay_steps < max(self.steps, self.n_step):
            raise ValueError(
                f"replay_steps: expected at least steps ({self.steps}) and n_step ({self.n_step}), got {self.replay_steps}"
            )
        if self.atoms > 1 and not self.v_min < self.v_max:
            raise ValueError(f"v_min: expected less than v_max ({self.v_max:g}), got {self.v_min:g}")
        return self
