"""Looks at gangs: several in one call of an engine, each with a failure of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from orchestrator.engines.api import Engine, GangStatus, Handle, Look


def one_by_one(look: Callable[[Handle], GangStatus], handles: Sequence[Handle]) -> list[Look]:
    """:meth:`Engine.observe` of an engine that looks at one gang at a time."""
    return [_tried(look, handle) for handle in handles]


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
