"""Routes whose functions use the store: they are carried out on the store's threads, and refused where it does not answer."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from contextvars import ContextVar
from functools import partial, wraps
from inspect import iscoroutinefunction
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute

from orchestrator.control.store_calls import StoreCalls
from orchestrator.domain.errors import Unavailable

_LONG = ("verify", "archived")
"""Query parameters that ask for much."""
_calls: ContextVar[StoreCalls] = ContextVar("_calls")


class StoreRoute(APIRoute):
    """A route of a function that uses the store: what only reads must end sooner than what changes or verifies something."""

    may_take_long = False
    """Whether also what only reads may take as long."""

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        reads = not self.may_take_long and set(options.get("methods") or ["GET"]) <= {"GET", "HEAD"}
        super().__init__(path, endpoint if iscoroutinefunction(endpoint) else _on_store(endpoint, reads), **options)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()

        async def answer(request: Request) -> Response:
            _calls.set(request.app.state.controller.access.calls)
            return await handler(request)

        return answer


class WorkRoute(StoreRoute):
    """A route of a function that may look at the whole store."""

    may_take_long = True


def _on_store(endpoint: Callable[..., Any], reads: bool) -> Callable[..., Coroutine[Any, Any, Any]]:
    @wraps(endpoint)
    async def answer(**parameters: Any) -> Any:
        works = not reads or any(parameters.get(each) for each in _LONG)
        try:
            return await _calls.get().answer(partial(endpoint, **parameters), works=works)
        except OSError as error:
            raise Unavailable(
                f"something in the store can't be used ({error}); see whether its volume is well, and try again"
            ) from error

    return answer
