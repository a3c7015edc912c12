"""Settings of SAC; importable without torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, Strict, model_validator
from pydantic.dataclasses import dataclass

LOG_STD = (-5.0, 0.0)
"""The logarithm of the policy's standard deviation, before squashing, stays between these (arXiv:2512.01996)."""

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0)]
Fraction = Annotated[float, Field(gt=0.0, le=1.0)]
Sizes = Annotated[tuple[Count, ...], Strict(False), Field(min_length=1)]
"""A list or a tuple of counts, each of them strictly a whole number."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class SACConfig:
    """Soft actor-critic for one task.

    The defaults are near those of FastSAC (arXiv:2512.01996), for thousands of worlds of a robot on a GPU. For a small task on a
    processor, set smaller networks, a smaller batch and larger learning rates; for every task, a ``v_min`` and a ``v_max`` that its
    discounted returns come near to and do not leave.

    Types are strict: a whole number is a number, but true is none, and neither is text.

    Raises:
        pydantic.ValidationError: A ValueError that names the field.
    """

    steps: Count = 4
    """Control steps of every world in one iteration."""
    updates: Count = 16
    """Updates of the critics in one iteration; a multiple of ``policy_delay``."""
    policy_delay: Count = 2
    """The policy and the temperature learn in every so-manieth update of the critics."""
    batch_size: Count = 8192
    """Transitions of one update, of all ranks together."""
    replay_steps: Count = 1024
    """The newest steps of every world that are kept, at least ``steps`` and ``n_step``.

    A step of a world costs ``4 · (2 · observations + actions + 3)`` bytes of the device's memory; where the critics read a group of
    their own, its observations count too. :mod:`worker.learning.sac.replay` says what is stored."""
    warm_up: Annotated[int, Field(ge=0)] = 8
    """Steps of every world that the replay has to hold before anything is learnt; until the first update, actions are drawn
    uniformly from within the limit."""
    save_replay: Literal[True, False, "auto"] = "auto"
    """Whether checkpoints hold the replay. Without it they are small, and a resumed run fills a new one first: it goes on, but not
    as if it had never stopped. ``"auto"``: where the replay of a rank is small, see :data:`worker.learning.sac.sac.SAVED`. With it, a
    GPU holds the replay twice from the first save on."""

    actor_sizes: Sizes = (512, 256, 128)
    """Widths of the hidden layers of the policy."""
    critic_sizes: Sizes = (768, 384, 192)
    """Widths of the hidden layers of each critic."""
    critics: Count = 2
    """How many critics are learnt, each from its own first weights."""
    layer_norm: bool = True
    """Whether each hidden layer of the policy and of the critics is normalised: keeps critics that learn often from diverging."""
    critic_group: str = "policy"
    """The observation group that the critics read; ``critic`` is what the simulation knows, without noise. The policy reads
    ``policy``."""
    normalize_observations: bool = True
    """Whether observations are normalised by their running mean and variance."""

    atoms: Count = 101
    """Values on which the critics put a distribution of the return (arXiv:1707.06887); 1: they predict its mean alone."""
    v_min: float = -20.0
    """The least of these values [discounted return]; not used with one atom."""
    v_max: float = 20.0
    """The greatest of them [discounted return]: a return beyond it can't be told from it."""
    combine: Literal["mean", "min"] = "mean"
    """What the critics' predictions become in targets and for the policy: ``"mean"``; or ``"min"``, the most cautious one."""

    gamma: Annotated[float, Field(ge=0.0, le=1.0)] = 0.97
    """Discount of the reward per control step; 0.97 looks half a second ahead at 50 Hz."""
    n_step: Count = 3
    """Rewards in a target before it takes the critics' word: several spread what was rewarded faster, and are of older policies."""
    tau: Fraction = 0.125
    """Part by which the target critics follow the critics in each update."""

    actor_learning_rate: Positive = 3.0e-4
    """Step size of AdamW for the policy."""
    critic_learning_rate: Positive = 3.0e-4
    """Step size of AdamW for the critics."""
    temperature_learning_rate: Positive = 3.0e-4
    """Step size of AdamW for the logarithm of the temperature."""
    weight_decay: Annotated[float, Field(ge=0.0)] = 1.0e-3
    """Part of each weight that AdamW takes away in a step, times the learning rate; none of the temperature."""
    max_grad_norm: Annotated[float, Field(ge=0.0)] = 0.0
    """Norm to which the gradients of the critics, and of the policy, are clipped; 0: they are not."""

    action_limit: Positive = 1.0
    """Actions lie strictly within ± this [unit of the action]; tasks clip theirs at ± 1."""
    init_std: Annotated[float, Field(gt=math.exp(LOG_STD[0]), lt=math.exp(LOG_STD[1]))] = 0.5
    """Standard deviation of the first policy, before squashing [action limit]."""
    target_entropy: float = 0.0
    """Entropy of each component of the action that the temperature keeps up on average [nat], in units of the action limit; 0 is that
    of a uniform choice from half the range, and −1 is usual for SAC (arXiv:1812.05905)."""
    init_temperature: Positive = 1.0e-3
    """Worth of the policy's entropy at the beginning [reward per nat]."""

    fixed: ClassVar[tuple[str, ...]] = (
        *("actor_sizes", "critic_sizes", "critics", "layer_norm", "critic_group", "normalize_observations"),
        *("atoms", "v_min", "v_max", "replay_steps", "action_limit", "init_std", "init_temperature"),
    )
    """What a resumed run can't change: checkpoints hold what became of it."""
    clone_may_change: ClassVar[tuple[str, ...]] = ("replay_steps", "init_temperature")
    """Those of :attr:`fixed` that a clone can change: it takes over weights and normalisers alone."""

    def check_observations(self, groups: Mapping[str, bool]) -> None:
        """Raises ValueError where the task lacks a group, or has images where numbers are expected.

        Args:
            groups: Those of the task, and of each whether it is of images.
        """
        if self.critic_group not in groups:
            known = ", ".join(groups)
            raise ValueError(f"critic_group: there is no observation group {self.critic_group!r}; there are {known}")
        if images := [group for group in ("policy", self.critic_group) if groups[group]]:
            raise ValueError(f"it can't learn from images, and observation group {images[0]!r} is one; use ppo")

    def check_actions(self, chooses: bool) -> None:
        """Raises ValueError for a task whose policy chooses one of several actions."""
        if chooses:
            raise ValueError("its actions are numbers from a range, and this task's are choices; use ppo")

    @model_validator(mode="after")
    def _fits(self) -> SACConfig:
        """What two fields have to do with each other."""
        if self.updates % self.policy_delay:
            raise ValueError(f"updates: expected a multiple of policy_delay ({self.policy_delay}), got {self.updates}")
        if self.replay_steps < max(self.steps, self.n_step):
            raise ValueError(
                f"replay_steps: expected at least steps ({self.steps}) and n_step ({self.n_step}), got {self.replay_steps}"
            )
        if self.atoms > 1 and not self.v_min < self.v_max:
            raise ValueError(f"v_min: expected less than v_max ({self.v_max:g}), got {self.v_min:g}")
        return self
