"""The algorithms by their names in ``train.algorithm``."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import sys
import tomllib
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from pydantic_core import ArgsKwargs

from shared_store.contract.entry_points import clash
from shared_store.contract.error_text import explain, nearest, path_of, shown
from worker.learning.algorithm import Algorithm
from worker.settings.errors import UserError
from worker.settings.task import TaskConfig

DEFAULT = "ppo"
_GROUP = "muster.algorithms"
_REPLACED = {
    "worker.learning.plain_ppo:PlainPPO": "algorithm ppo computes the same: set train.algorithm: ppo, with these settings under ppo"
}
"""Classes of earlier versions, and what replaces them."""


def installed() -> dict[str, str]:
    """The class (``module:Class``) of each installed algorithm, by name, from the entry points ``muster.algorithms``."""
    found = {point.name: point.value for point in entry_points(group=_GROUP)}
    source = Path(__file__).parents[2] / "pyproject.toml"
    if not found and source.exists():  # a source tree on the path, not installed
        found = tomllib.loads(source.read_text())["project"]["entry-points"][_GROUP]
    return found


def section_of(name: str) -> str:
    """The section of ``train`` with an algorithm's settings: its name, or ``settings`` for a user's own."""
    return "settings" if ":" in name else name


def find_algorithm(name: str) -> type[Algorithm]:
    """The class of an algorithm. Raises UserError for an unknown name, and for one that two packages give.

    Args:
        name: One of :func:`installed`, or ``module:Class`` of a user's own, importable from the job's directory.
    """
    if words := clash(entry_points(group=_GROUP), name):
        raise UserError(f"train.algorithm: {words}")
    if name in _REPLACED:
        raise UserError(f"train.algorithm: {name} is no longer part of Muster; {_REPLACED[name]}")
    known = installed()
    place = name if ":" in name else known.get(name, "")
    module, _, attribute = place.partition(":")
    if not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", place):
        names = ", ".join(sorted(known)) or "none, since no package is installed here that names any"
        raise UserError(
            f"train.algorithm: no algorithm is called {shown(name)}; known: {names}, and module:Class of your own"
        )
    if place == name and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # as for a user's own task (worker.tasks)
    try:
        found: type[Algorithm] = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(f"train.algorithm: {name}: {error}") from error
    refuse_incomplete(found, name, ("config_type", "captures_rollout", *_METHODS))
    return found


_METHODS = [name for name in vars(Algorithm) if not name.startswith("_")]


def refuse_incomplete(found: object, name: str, parts: Sequence[str]) -> None:
    """Raises UserError with the names of the ``parts`` that ``found`` lacks."""
    if missing := [part for part in parts if not hasattr(found, part)]:
        raise UserError(
            f"train.algorithm: {name} is not an algorithm: it lacks {', '.join(missing)} (worker.learning.algorithm)"
        )


def check_state(algorithm: Algorithm, name: str) -> None:
    """Raises UserError if the state of an algorithm lacks the policy, which evaluation and export read."""
    if not isinstance(algorithm.state_dict().get("policy"), Mapping):
        raise _mistake(name, 'state_dict() must hold "policy", the state_dict() of its policy')


def check_actions(actions: Any, expected: torch.Size, name: str) -> None:
    """Raises UserError for actions other than a tensor of the ``expected`` shape."""
    if not isinstance(actions, torch.Tensor) or actions.shape != expected:
        shape = f"a tensor of shape {tuple(expected)} (worlds, actions)"
        raise _mistake(name, f"act() must give {shape}; it gave {_shape_of(actions)}")


def check_metrics(metrics: Any, name: str) -> None:
    """Raises UserError for metrics that are not scalar tensors by name."""
    if not isinstance(metrics, Mapping):
        raise _mistake(name, f"learn() must give a mapping of metrics, not a {type(metrics).__name__}")
    for key, value in metrics.items():
        if not isinstance(value, torch.Tensor) or value.shape != ():
            raise _mistake(name, f"learn() must give tensors of shape (); its metric {key} is {_shape_of(value)}")


def check_names(metrics: Collection[str], record: Collection[str], name: str) -> None:
    """Raises UserError for a metric with the name of a number that every record has."""
    if taken := sorted(set(metrics) & set(record)):
        raise _mistake(name, f"a metric of learn() can't be called {taken[0]}: every record has one")


def _mistake(name: str, problem: str) -> UserError:
    return UserError(f"train.algorithm: {name}: {problem}")


def _shape_of(value: Any) -> str:
    return str(tuple(value.shape)) if isinstance(value, torch.Tensor) else type(value).__name__


def settings(algorithm: type[Algorithm], name: str, config: TaskConfig, section: Mapping[str, Any]) -> Any:
    """The algorithm's settings: the task's own for it, with the job's changes. Raises UserError naming the key.

    Args:
        section: The job's ``train``: settings stand under the algorithm's name, those of a user's own under ``settings``.
    """
    where = section_of(name)
    changes = section.get(where) or {}
    own = getattr(config, name, None)
    base = {item.name: getattr(own, item.name) for item in dataclasses.fields(own) if item.init} if own else {}
    kind: Any = algorithm.config_type
    if not dataclasses.is_dataclass(algorithm.config_type):
        raise UserError(f"train.algorithm: {name}: its config_type must be a dataclass, not {kind.__name__}")
    known = [item.name for item in dataclasses.fields(kind)]
    for key in changes:
        if key not in known:
            hint = getattr(kind, "elsewhere", {}).get(key) or nearest(key, sorted(known))
            raise UserError(f"train.{where}.{key}: there is no such setting; {hint}")
    try:
        return kind(**{**base, **changes})
    except (TypeError, ValueError) as error:
        raise UserError(refusal(where, error)) from error


def refusal(where: str, error: TypeError | ValueError) -> str:
    """The error of refused settings in one line; ``where``: their section of ``train``."""
    if not isinstance(error, ValidationError):
        return f"train.{where}: {' '.join(str(error).split())}"
    first: Any = error.errors(include_url=False)[0]
    if isinstance(first.get("input"), ArgsKwargs):  # the message of a rule over several fields is complete
        first["input"] = {}
    return f"{'.'.join(map(str, ('train', where, *path_of(first))))}: {explain(first)}"[:1000]
