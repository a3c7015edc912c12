"""The store as requests use it: a pool of threads for its volume, with deadlines, since the volume may hang.

Whoever waits for the store holds neither the database nor a lock meanwhile.
"""

from __future__ import annotations

import asyncio
import contextvars
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from orchestrator import machine
from orchestrator.domain.errors import Unavailable

T = TypeVar("T")

THREADS, WAITING = 16, 240
"""Calls that are carried out at once, and that wait for that."""
PATIENCE = 20.0
"""Seconds for which a request waits for what it reads; clients wait for 30."""
WORK = 600.0
"""Seconds for which a request waits that copies or verifies a checkpoint."""
_CALLERS = 16
"""Threads of requests that wait at once: the others serve what needs no store."""
_TURN = 1.0
"""Seconds for which another one waits for its turn."""

_inside = contextvars.ContextVar("_inside", default=False)
"""Whether this thread is one of the pool's."""


class StoreSilent(Unavailable):
    """The store does not answer in time, or too many requests wait for it."""


class StoreCalls:
    """Calls on the store for requests. Any thread may use it."""

    def __init__(self, path: Path, is_silent: Callable[[], bool] = lambda: False) -> None:
        """``is_silent``: whether the volume is known not to answer; then no call is tried."""
        self._path, self._is_silent, self.patience = path, is_silent, PATIENCE
        self._pool = machine.pool("store of requests", THREADS, WAITING)
        self._callers, self._lock = threading.Semaphore(_CALLERS), threading.Lock()
        self.open = self.refused = 0
        """Calls that have not returned, and those that were refused or late since the beginning."""

    def call(self, body: Callable[[], T]) -> T:
        """The result of ``body``, for a thread that waits. Raises StoreSilent, and what it raises."""
        if _inside.get():
            return body()
        if self._is_silent() or not self._callers.acquire(timeout=_TURN):
            raise self._silence("its volume is silent" if self._is_silent() else f"{_CALLERS} requests wait for it")
        try:
            future = self._submit(body)
            try:
                return machine.result(future, self.patience)
            except TimeoutError:
                future.cancel()
                raise self._silence(f"not within {self.patience:.0f} s") from None
        finally:
            self._callers.release()

    async def answer(self, body: Callable[[], T], *, works: bool = False) -> T:
        """The result of ``body``, for the event loop; ``works``: it may take long. Raises StoreSilent, and what it raises."""
        seconds = WORK if works else self.patience
        try:
            return await asyncio.wait_for(asyncio.wrap_future(self._submit(body)), seconds)
        except TimeoutError:
            raise self._silence(f"not within {seconds:.0f} s") from None

    def close(self) -> None:
        """Leave the calls that hang to themselves."""
        self._pool.close()

    def _submit(self, body: Callable[[], T]) -> Future[T]:
        if self._is_silent():
            raise self._silence("its volume is silent")
        context = contextvars.copy_context()
        context.run(_inside.set, True)
        try:
            future = self._pool.submit(partial(context.run, body))
        except machine.PoolFull:
            raise self._silence(f"{THREADS + WAITING} requests wait for it") from None
        with self._lock:
            self.open += 1
        future.add_done_callback(self._returned)
        return future

    def _returned(self, _: Future[Any]) -> None:
        with self._lock:
            self.open -= 1

    def _silence(self, why: str) -> StoreSilent:
        self.refused += 1
        return StoreSilent(
            f"the store at {self._path} does not answer ({why}); see whether its server can be reached, and try again"
        )
