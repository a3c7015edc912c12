"""Named terms for declared tasks: small Warp functions for actions, observations, rewards, terminations, commands and events.

A task uses them as ``terms.NAME``. Those that no shipped task needs are in :mod:`worker.tasks.terms.more`, which is imported when one
of them is used. ``terms.mjlab.NAME`` and ``terms.isaaclab.NAME`` find a term by its name there. ``docs/tasks/terms.md`` lists all terms.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any

import warp as wp

from shared_store.contract.error_text import nearest
from worker.tasks.terms.tolerances import ToleranceArrays as ToleranceArrays
from worker.tasks.terms.tolerances import Tolerances as Tolerances

GROUPS = (
    *("joints", "root", "bodies", "actions", "commands", "events", "episode", "locomotion", "tolerances"),
    *("contacts", "sensing", "ground", "footing", "manipulation", "selecting"),
)
"""Modules of terms, in the order of the documentation."""


def terms_of(module: ModuleType) -> dict[str, wp.Function]:
    """The terms that a module defines, by name: its public Warp functions whose first parameter is ``world``."""
    return {
        name: each
        for name, each in vars(module).items()
        if isinstance(each, wp.Function)
        and each.func is not None
        and each.func.__module__ == module.__name__
        and each.func.__code__.co_varnames[:1] == ("world",)
        and not name.startswith("_")
    }


for _group in GROUPS:
    globals().update(terms_of(import_module(f"{__name__}.{_group}")))


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in ("more", "mjlab", "isaaclab"):
        return import_module(f"{__name__}.{name}")
    further = vars(import_module(f"{__name__}.more"))
    if name not in further:
        raise AttributeError(f"there is no term {name!r}; {nearest(name, __dir__())}")
    return further[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *vars(import_module(f"{__name__}.more")), "mjlab", "isaaclab"})
