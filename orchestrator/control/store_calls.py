"""Calls on the store for requests: a pool of threads for its volume, with deadlines, since the volume may hang.

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
    """The store is not there, it does not answer in time, or too many requests wait for it."""


class StoreCalls:
    """Calls on the store for requests. Any thread may use it."""

    def __init__(self, path: Path, problem: Callable[[], str | None] = lambda: None) -> None:
        """``problem``: why the store can't be read, as far as is known; then no call is tried."""
        self._path, self._problem, self.patience = path, problem, PATIENCE
        self._pool = machine.pool("store of requests", THREADS, WAITING)
        self._tidying = machine.pool("tidying the store", THREADS + 1)
        """One thread more than calls that hang and may have to be waited for."""
        self._callers, self._lock = threading.Semaphore(_CALLERS), threading.Lock()
        self.open = self.refused = 0
        """Calls that have not returned, and those that were refused or late since the beginning."""

    def call(self, body: Callable[[], T], *, works: bool = False) -> T:
        """The result of ``body``, for a thread that waits; ``works``: it may take long. Raises StoreSilent, and what it raises."""
        if _inside.get():
            return body()
        self._check()
        if not self._callers.acquire(timeout=_TURN):
            raise self._silence(f"{_CALLERS} requests wait for it")
        try:
            future, seconds = self.submit(body), WORK if works else self.patience
            try:
                return machine.result(future, seconds)
            except TimeoutError:
                future.cancel()
                raise self._silence(f"not within {seconds:.0f} s") from None
        finally:
            self._callers.release()

    async def answer(self, body: Callable[[], T], *, works: bool = False) -> T:
        """The result of ``body``, for the event loop; ``works``: it may take long. Raises StoreSilent, and what it raises."""
        seconds = WORK if works else self.patience
        try:
            return await asyncio.wait_for(asyncio.wrap_future(self.submit(body)), seconds)
        except TimeoutError:
            raise self._silence(f"not within {seconds:.0f} s") from None

    def later(self, body: Callable[[], object]) -> None:
        """Let ``body`` close or delete what a call has left, also where it must wait for that call; nobody waits for it."""
        self._tidying.submit(body)

    def close(self) -> None:
        """Leave the calls that hang to themselves."""
        self._pool.close()
        self._tidying.close()

    def submit(self, body: Callable[[], T]) -> Future[T]:
        """The result of ``body``, whenever the store gives it. Raises StoreSilent."""
        self._check()
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

    def _check(self) -> None:
        if (problem := self._problem()) is not None:
            self.refused += 1
            raise StoreSilent(problem)

    def _returned(self, _: Future[Any]) -> None:
        with self._lock:
            self.open -= 1

    def _silence(self, why: str) -> StoreSilent:
        self.refused += 1
        return StoreSilent(
            f"the store at {self._path} does not answer ({why}); see whether its server can be reached, and try again"
        )
