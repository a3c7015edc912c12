"""Statuses of gangs: those of several in one call of an engine, each with a failure of its own, and that of a node that has ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from inspect import signature
from typing import Any

from orchestrator.engines.api import Cause, Engine, GangStatus, Handle, NodePhase, NodeStatus, StatusOrError


def ended(address: str, exit_code: int | None, words: str = "", gpus: tuple[str, ...] = ()) -> NodeStatus:
    """A node that has ended: unobserved (None), by a signal (128 + n), or by itself."""
    cause = Cause.HOST_LOST if exit_code is None else Cause.SIGNAL if exit_code > 128 else Cause.EXIT
    return NodeStatus(NodePhase.ENDED, address, words, cause, exit_code, gpus)


def one_by_one(observe: Callable[[Handle], GangStatus], handles: Sequence[Handle]) -> list[StatusOrError]:
    """:meth:`Engine.observe` of an engine that observes one gang at a time with ``observe``."""
    statuses: list[StatusOrError] = []
    for handle in handles:
        try:
            statuses.append(observe(handle))
        except (Exception, SystemExit) as error:  # the runner tells a failure that may pass from a bug, and reports it
            statuses.append(error)
    return statuses


def observing_several(engine: Engine) -> Engine:
    """The engine, with an ``observe`` that takes several handles: engines of earlier versions have ``observe(handle)``."""
    if "handle" in signature(engine.observe).parameters:
        single: Any = engine.observe
        engine.observe = partial(one_by_one, single)  # type: ignore[method-assign]
    return engine


def status_of(engine: Engine, handle: Handle) -> GangStatus:
    """The status of one gang. Raises the error that the engine has in its place."""
    [status] = engine.observe([handle])
    if isinstance(status, BaseException):
        raise status
    return status
