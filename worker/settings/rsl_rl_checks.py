"""Checks of the section ``algorithm`` of rsl_rl's classes beforehand, since rsl_rl would fail on it only while it learns.

For a user's class, only the common keys are checked. Imported without torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Required

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from shared_store.contract.error_text import Refused, explain, kind_of, nearest, shown

_checked = with_config(ConfigDict(strict=True, extra="forbid", allow_inf_nan=False))
Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Widths = Annotated[list[int], Field(min_length=1)]


@_checked
class _Fixed(TypedDict):
    mode: Literal["constant"]


@_checked
class _Step(TypedDict):
    mode: Literal["step"]
    final_step: int
    final_value: float


@_checked
class _Linear(TypedDict):
    mode: Literal["linear"]
    initial_step: int
    final_step: int
    final_value: float


@_checked
class _Rnd(TypedDict, total=False):
    num_outputs: Required[Count]
    predictor_hidden_dims: Required[Widths]
    target_hidden_dims: Required[Widths]
    weight: Required[float]
    weight_schedule: dict[str, Any] | None
    learning_rate: float
    activation: str
    state_normalization: bool
    reward_normalization: bool


@_checked
class _Symmetry(TypedDict, total=False):
    data_augmentation_func: Required[str]
    use_data_augmentation: bool
    use_mirror_loss: bool
    mirror_loss_coeff: float


class _Any(TypedDict, total=False):
    class_name: str
    num_learning_epochs: Count
    learning_rate: float
    optimizer: str
    use_mixed_precision: bool
    grad_reduce_bucket_mb: float


@_checked
class _PPO(_Any, total=False):
    num_mini_batches: Count
    clip_param: float
    gamma: Fraction
    lam: Fraction
    value_loss_coef: float
    entropy_coef: float
    max_grad_norm: float
    use_clipped_value_loss: bool
    schedule: Literal["adaptive", "fixed"]
    desired_kl: float | None
    normalize_advantage_per_mini_batch: bool
    share_cnn_encoders: bool | None
    rnd_cfg: _Rnd | None
    symmetry_cfg: _Symmetry | None


@_checked
class _Distillation(_Any, total=False):
    gradient_length: Count
    max_grad_norm: float | None
    loss_type: Literal["mse", "huber"]


_SECTIONS: Mapping[str, Any] = {"PPO": TypeAdapter(_PPO), "Distillation": TypeAdapter(_Distillation)}
_SCHEDULES: Mapping[Any, Any] = {
    "constant": TypeAdapter(_Fixed),
    "step": TypeAdapter(_Step),
    "linear": TypeAdapter(_Linear),
}


def class_of(section: Mapping[str, Any]) -> str | None:
    """``PPO`` or ``Distillation`` if an ``algorithm`` section names rsl_rl's own class; None for another class."""
    name = section.get("class_name", "PPO")
    if not isinstance(name, str):
        raise Refused(("class_name",), f"expected a string, found {shown(name)}")
    module, _, last = name.replace(":", ".").rpartition(".")
    return last if last in _SECTIONS and (not module or module.partition(".")[0] == "rsl_rl") else None


def check_algorithm(section: dict[str, Any] | None) -> dict[str, Any] | None:
    """The section unchanged, None if a job omits it. Raises Refused for a value that rsl_rl's own classes can't use, and for a number
    that is not finite."""
    check_finite(section)
    if section is None:
        return None
    if kind := class_of(section):
        _check(_SECTIONS[kind], section, ())
    curiosity = section.get("rnd_cfg") if kind == "PPO" else None
    if curiosity and (schedule := curiosity.get("weight_schedule")) is not None:
        mode = schedule.get("mode")
        if mode not in _SCHEDULES:
            words = f"expected {', '.join(_SCHEDULES)}, found {shown(mode)}" if mode is not None else "is required"
            raise Refused(("rnd_cfg", "weight_schedule", "mode"), words)
        _check(_SCHEDULES[mode], schedule, ("rnd_cfg", "weight_schedule"))
    return section


def check_finite(value: Any, path: tuple[str | int, ...] = ()) -> Any:
    """The document ``value``. Raises Refused for a number that is not finite, which a job in JSON can't hold."""
    if isinstance(value, float) and not math.isfinite(value):
        raise Refused(path, f"expected a finite number, found {kind_of(value)}")
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list | tuple) else ()
    for key, item in items:
        check_finite(item, (*path, key))
    return value


def check_networks(kind: str, distils: bool, supplied: Mapping[str, Any], teacher: str | None) -> tuple[str, str]:
    """The names of an algorithm's two networks, the policy first.

    Args:
        kind: Name of its class.
        distils: Whether it imitates a teacher.
        supplied: The job's sections of networks, by name; None for omitted ones.
        teacher: The run that trained the teacher.

    Raises:
        Refused: A network is not one of the algorithm's, a teacher is missing, or the algorithm has no teacher.
    """
    names = ("student", "teacher") if distils else ("actor", "critic")
    for other, section in supplied.items():
        if other not in names and section is not None:
            raise Refused((other,), f"{kind} has the networks {' and '.join(names)}")
    if bool(teacher) != distils:
        text = "name the run that trained the teacher" if distils else f"{kind} has no teacher; leave it out"
        raise Refused(("teacher_checkpoint",), text)
    return names


def check_gradient_length(length: int, epochs: int, steps: int) -> None:
    """Raises Refused if an iteration of Distillation is too short for a single step of the optimizer."""
    if length > epochs * steps:
        raise Refused(
            ("algorithm", "gradient_length"),
            f"nothing is learnt in {epochs * steps} steps an iteration, {length} are needed",
        )


def _check(kind: TypeAdapter[Any], section: Mapping[str, Any], where: tuple[str | int, ...]) -> None:
    try:
        kind.validate_python(section)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        words = explain(first)
        if first["type"] == "extra_forbidden":
            words = f"there is no such key; {nearest(str(first['loc'][-1]), _keys(kind, first['loc']))}"
        raise Refused((*where, *first["loc"]), words) from None


def _keys(kind: TypeAdapter[Any], path: tuple[str | int, ...]) -> list[str]:
    """The known keys at ``path``."""
    schema = kind.json_schema()
    found = schema
    for part in path[:-1]:
        options = found["properties"][part]
        for option in options.get("anyOf", [options]):
            found = schema["$defs"][option["$ref"].rpartition("/")[2]] if "$ref" in option else found
    return sorted(found["properties"])
