"""Looks at gangs: several in one call of an engine, each with a failure of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from inspect import signature
from typing import Any

from orchestrator.engines.api import Engine, GangStatus, Handle, Look


def one_by_one(look: Callable[[Handle], GangStatus], handles: Sequence[Handle]) -> list[Look]:
    """:meth:`Engine.observe` of an engine that looks at one gang at a time."""
    return [_tried(look, handle) for handle in handles]


def observing_several(engine: Engine) -> Engine:
    """The engine, with an ``observe`` that takes several handles.

    Engines of others may be older than that: one whose ``observe(handle)`` takes a single handle is asked for one gang at a time.
    """
    if "handle" in signature(engine.observe).parameters:
        single: Any = engine.observe
        engine.observe = partial(one_by_one, single)  # type: ignore[method-assign]
    return engine


def status_of(engine: Engine, handle: Handle) -> GangStatus:
    """The status of one gang. Raises the error that the engine has in its place."""
    [look] = engine.observe([handle])
    if isinstance(look, BaseException):
        raise look
    return look


def _tried(look: Callable[[Handle], GangStatus], handle: Handle) -> Look:
    try:
        return look(handle)
    except (Exception, SystemExit) as error:  # the runner tells a failure that may pass from a bug, and reports it
        return error
