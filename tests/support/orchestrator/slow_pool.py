"""A pool whose calls return when the test says so."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any


class SlowPool:
    """Calls that return when the test says so, the oldest first."""

    busy_since = None

    def __init__(self) -> None:
        self.calls: list[tuple[Callable[[], Any], Future[Any]]] = []

    def submit(self, body: Callable[[], Any]) -> Future[Any]:
        self.calls.append((body, Future()))
        return self.calls[-1][1]

    def close(self, patience: float = 0.0) -> None:
        self.calls.clear()

    def carry_out(self) -> None:
        body, future = self.calls.pop(0)
        try:
            future.set_result(body())
        except Exception as error:
            future.set_exception(error)
