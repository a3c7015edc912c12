"""Settings of rsl_rl's algorithms, in rsl_rl's own keys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from shared_store.contract.error_text import Refused, nearest
from worker.settings.rsl_rl_checks import check_algorithm, check_finite, check_gradient_length, check_networks, class_of

_NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu", "obs_normalization": True}
_ACTOR = {**_NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}}

DEFAULTS: Mapping[str, dict[str, Any]] = {
    "algorithm": {"class_name": "PPO"},
    "actor": _ACTOR,
    "critic": _NETWORK,
    "student": {**_NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.1}},
    "teacher": _ACTOR,
}
"""Defaults of the sections that a job omits. Keys without a default here have rsl_rl's."""

NETWORKS = ("actor", "critic", "student", "teacher")
"""Names of networks, which are also those of configuration sections and of observation sets."""
SETS = (*NETWORKS, "rnd_state")
"""Names of observation sets of rsl_rl's own algorithms."""
Network = Annotated[dict[str, Any], AfterValidator(check_finite)]

_LOGS = "every run writes metrics.jsonl and TensorBoard's files by itself"
_RESUME = "a run goes on from its checkpoint with `muster resume RUN`"
_NAMED = "use the job's name and run"
REFUSED: Mapping[str, str] = {
    "max_iterations": "use train.iterations",
    "num_envs": "use train.worlds",
    "seed": "use train.seed",
    "device": "use resources.gpus",
    "multi_gpu": "use nodes and resources.gpus",
    "save_interval": "use checkpoint.every",
    "resume": _RESUME,
    "load_run": _RESUME,
    "load_checkpoint": _RESUME,
    "run_name": _NAMED,
    "experiment_name": _NAMED,
    "log_dir": _NAMED,
    "logger": _LOGS,
    "wandb_project": _LOGS,
    "neptune_project": _LOGS,
    "check_for_nan": "a value that is not finite always ends training; use config.nan_limit for worlds that fail",
    "init_at_random_ep_len": "it is always so at the beginning of a run",
    "clip_actions": "tasks clip actions themselves",
    "class_name": "use algorithm.class_name: there is no runner to choose",
    "runner_class_name": "use algorithm.class_name: there is no runner to choose",
    "policy": "since version 5 rsl_rl has the sections actor and critic",
    "empirical_normalization": "use obs_normalization in actor and critic",
}
"""Keys of rsl_rl's runners that Muster replaces, and the alternatives."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RslRlConfig:
    """The configuration of rsl_rl's runner, without the parts that Muster does instead.

    A section with a ``class_name`` is used unchanged, as in rsl_rl. A section without one overrides :data:`DEFAULTS` key by key, and so
    does a ``distribution_cfg`` in it. Sections may have any key that their class knows.

    Raises:
        ValidationError: A key is unknown, or a value has the wrong type or is out of range.
    """

    num_steps_per_env: Annotated[int, Field(strict=True, ge=1)] = 24
    """Control steps of every world in one iteration."""
    obs_groups: dict[str, list[str]] = field(default_factory=dict)
    """The task's observation groups in each set: ``actor``, ``critic``, ``rnd_state``, ``student``, ``teacher``. By rsl_rl's rule, a
    missing set is the group of the same name, or else ``policy``: the critic sees the group ``critic``."""
    algorithm: Annotated[dict[str, Any], AfterValidator(check_algorithm)] = field(default_factory=dict)
    """``PPO``, ``Distillation`` or ``module:Class``, with ``rnd_cfg``, ``symmetry_cfg`` and the rest."""
    actor: Network | None = None
    """The policy's network, for PPO."""
    critic: Network | None = None
    """The value network, for PPO."""
    student: Network | None = None
    """The learning network, for Distillation."""
    teacher: Network | None = None
    """The imitated network, for Distillation: the ``actor`` of the run that trained it."""
    teacher_checkpoint: str | None = None
    """Source of the teacher's weights, for Distillation: ``RUN`` or ``RUN@ITERATION``. A key of Muster, not of rsl_rl."""
    torch_compile_mode: str | None = None
    """Compile the networks with ``torch.compile``: ``default`` or ``max-autotune-no-cudagraphs``."""

    fixed: ClassVar[tuple[str, ...]] = (
        *("obs_groups", "actor", "critic", "student", "teacher", "teacher_checkpoint"),
        *("algorithm.class_name", "algorithm.optimizer"),
        *(f"algorithm.rnd_cfg.{name}" for name in ("num_outputs", "predictor_hidden_dims", "target_hidden_dims")),
        *(f"algorithm.rnd_cfg.{name}" for name in ("activation", "state_normalization", "reward_normalization")),
        "algorithm.rnd_cfg.learning_rate",
    )
    """Settings that a resumed run can't change, since its checkpoints depend on them. A dot leads into a section."""
    clone_may_change: ClassVar[tuple[str, ...]] = (
        "teacher_checkpoint",
        *(name for name in fixed if name.startswith("algorithm.")),
    )
    """Those of :attr:`fixed` that a clone can change, since it takes over only weights and normalisers."""
    elsewhere: ClassVar[Mapping[str, str]] = REFUSED
    """Settings that people look for here, and the alternatives."""

    @model_validator(mode="after")
    def _agree(self) -> RslRlConfig:
        section = self.section("algorithm")
        if kind := class_of(section):
            for name in self.obs_groups:
                if name not in SETS:
                    raise Refused(("obs_groups", name), f"{kind} has no such set; {nearest(name, SETS)}")
            supplied = {name: getattr(self, name) for name in NETWORKS}
            check_networks(kind, kind == "Distillation", supplied, self.teacher_checkpoint)
        if kind == "Distillation":
            epochs, length = section.get("num_learning_epochs", 1), section.get("gradient_length", 15)
            check_gradient_length(length, epochs, self.num_steps_per_env)
        return self

    def check_observations(self, groups: Mapping[str, bool]) -> None:
        """Raises ValueError if a set names a group that the task does not have.

        Args:
            groups: The task's groups, and whether each holds images.
        """
        for name, requested in self.obs_groups.items():
            for group in requested:
                if group not in groups:
                    known = ", ".join(groups)
                    raise ValueError(f"obs_groups: {name}: there is no observation group {group!r}; available: {known}")

    def check_actions(self, chooses: bool) -> None:
        """Raises ValueError for a task whose policy chooses one of several actions."""
        if chooses:
            raise ValueError("its distributions are of numbers, and the actions of this task are choices; use ppo")

    def section(self, name: str) -> dict[str, Any]:
        """Section ``name`` in rsl_rl's form, with its ``class_name``. It is a copy."""
        return _changed(DEFAULTS[name], getattr(self, name) or {})


def _changed(default: Mapping[str, Any], supplied: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of ``supplied``, or, if it names no class, of ``default`` with its changes."""
    known: Mapping[str, Any] = {} if "class_name" in supplied else default
    return {key: _copy(value, known.get(key)) for key, value in {**known, **supplied}.items()}


def _copy(value: Any, default: Any) -> Any:
    if isinstance(value, Mapping):
        return _changed(default if isinstance(default, Mapping) else {}, value)
    return list(value) if isinstance(value, list) else value
