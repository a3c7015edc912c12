"""The algorithms by the names that ``train.algorithm`` gives them."""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError
from pydantic_core import ArgsKwargs

from shared_store.wording import explain, path_of
from worker.errors import UserError
from worker.learning.algorithm import Algorithm
from worker.tasks.config import TaskConfig

BUILT_IN = {
    "ppo": "worker.learning.ppo.fused:PPO",
    "rsl_rl": "worker.learning.rsl.algorithm:RslRl",
    "sac": "worker.learning.sac.sac:SAC",
}
"""Where each is."""
DEFAULT = "ppo"


def find_algorithm(name: str) -> type[Algorithm]:
    """The class of an algorithm. Raises UserError for a name of none.

    Args:
        name: One of :data:`BUILT_IN`, or ``module:Class`` of a user's own, importable from the job's directory.
    """
    place = BUILT_IN.get(name, name)
    module, sign, attribute = place.partition(":")
    if not sign:
        raise UserError(
            f"train.algorithm: no algorithm is called {name!r}; known: {', '.join(BUILT_IN)}, and module:Class of your own"
        )
    if place == name and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # as a task of the user's own is found (worker.tasks)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(f"train.algorithm: {name}: {error}") from error
    refuse_incomplete(found, name, ("config_type", "captures_rollout", *_METHODS))
    return found  # type: ignore[no-any-return]


_METHODS = [name for name in vars(Algorithm) if not name.startswith("_")]


def refuse_incomplete(found: object, name: str, parts: Sequence[str]) -> None:
    """Raises UserError, with the names of those that are missing, where ``found`` has not all ``parts``."""
    if missing := [part for part in parts if not hasattr(found, part)]:
        raise UserError(
            f"train.algorithm: {name} is no algorithm: it lacks {', '.join(missing)} (worker.learning.algorithm)"
        )


def settings(algorithm: type[Algorithm], name: str, config: TaskConfig, section: Mapping[str, Any]) -> Any:
    """The algorithm's settings: the task's own for it, with what the job sets. Raises UserError naming the key.

    Args:
        section: The job's ``train``: settings stand under the algorithm's name, those of a user's own under ``settings``.
    """
    where = name if name in BUILT_IN else "settings"
    given = section.get(where) or {}
    own = getattr(config, name, None)
    base = {item.name: getattr(own, item.name) for item in dataclasses.fields(own) if item.init} if own else {}
    kind = algorithm.config_type
    known = [item.name for item in dataclasses.fields(kind)]
    for key in given:
        if key not in known:
            raise UserError(f"train.{where}.{key}: {unknown(key, known, getattr(kind, 'elsewhere', {}))}")
    try:
        return kind(**{**base, **given})
    except (TypeError, ValueError) as error:
        raise UserError(refusal(where, error)) from error


def refusal(where: str, error: TypeError | ValueError) -> str:
    """In one line what settings refuse; ``where``: their section of ``train``."""
    if not isinstance(error, ValidationError):
        return f"train.{where}: {' '.join(str(error).split())}"
    first: Any = error.errors(include_url=False)[0]
    if isinstance(first.get("input"), ArgsKwargs):  # of a rule over several fields the words say it all
        first["input"] = {}
    return f"{'.'.join(map(str, ('train', where, *path_of(first))))}: {explain(first)}"[:1000]


def unknown(key: str, known: list[str], elsewhere: Mapping[str, str]) -> str:
    """What to say of a setting that an algorithm does not have."""
    import difflib

    if key in elsewhere:
        return f"there is no such setting; {elsewhere[key]}"
    near = difflib.get_close_matches(key, known, n=1)
    return (
        f"there is no such setting; {f'did you mean {near[0]}?' if near else 'there are ' + ', '.join(sorted(known))}"
    )
