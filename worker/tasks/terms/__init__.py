# ruff: noqa: F403
"""Named terms for tasks: small Warp functions for actions, observations, rewards, terminations, commands and events.

A task uses them as ``terms.NAME``. Those that no shipped task needs are in :mod:`worker.tasks.terms.more`, which is imported when one
of them is used. ``terms.mjlab.NAME`` and ``terms.isaaclab.NAME`` find a term by its name there. ``docs/tasks/terms.md`` lists all terms.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

import warp as wp

from shared_store.contract.error_text import nearest
from worker.tasks.terms.tolerances import ToleranceArrays as ToleranceArrays
from worker.tasks.terms.tolerances import Tolerances as Tolerances

if TYPE_CHECKING:  # what an editor completes
    from worker.tasks.terms.actions import *
    from worker.tasks.terms.bodies import *
    from worker.tasks.terms.commands import *
    from worker.tasks.terms.contacts import *
    from worker.tasks.terms.episode import *
    from worker.tasks.terms.events import *
    from worker.tasks.terms.footing import *
    from worker.tasks.terms.ground import *
    from worker.tasks.terms.joints import *
    from worker.tasks.terms.locomotion import *
    from worker.tasks.terms.manipulation import *
    from worker.tasks.terms.more import *
    from worker.tasks.terms.more.actions import *
    from worker.tasks.terms.more.bodies import *
    from worker.tasks.terms.more.commands import *
    from worker.tasks.terms.more.contacts import *
    from worker.tasks.terms.more.episode import *
    from worker.tasks.terms.more.events import *
    from worker.tasks.terms.more.following import *
    from worker.tasks.terms.more.ground import *
    from worker.tasks.terms.more.joints import *
    from worker.tasks.terms.more.locomotion import *
    from worker.tasks.terms.more.manipulation import *
    from worker.tasks.terms.more.root import *
    from worker.tasks.terms.more.sensing import *
    from worker.tasks.terms.more.tracking import *
    from worker.tasks.terms.root import *
    from worker.tasks.terms.selecting import *
    from worker.tasks.terms.sensing import *

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
        raise AttributeError(
            f"there is no term {name!r}; {nearest(name, __dir__(), 'docs/tasks/terms.md lists them')}", name=None
        )
    return further[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *vars(import_module(f"{__name__}.more")), "mjlab", "isaaclab"})
