"""Streams of answers that go on while their client listens: counted by key, and fed by a pool of threads."""

from __future__ import annotations

import asyncio
import contextvars
from collections import Counter
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import TypeVar

from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from orchestrator import machine
from orchestrator.api.http.auth import error_response
from orchestrator.control.store_calls import StoreCalls

T = TypeVar("T")

MOST = 100
"""Answers of this kind that one key or user has at once."""
PIECE = 64 << 10
"""Bytes of a log that are read for one of them at once: one whose client does not read keeps them, and as much again."""
MEMORY_PIECE = 16 << 10
"""Bytes of each node's log that one of them takes from memory at once, on the event loop: a millisecond of work."""
_THREADS = 24
"""More than wait for the store at once, for the progress in a list of jobs: the others need no store."""
_SHARE = 0.001
"""Seconds between two looks, for each open answer: all of them together look 1,000 times a second, most of them at memory alone."""

_open: Counter[str] = Counter()
"""Number of open answers by the name of their reader; used by the event loop alone."""
_reads = machine.pool("followers", _THREADS)
"""Each open answer that needs no store has one call here at most."""


class Following(StreamingResponse):
    """A stream that takes one of its reader's places while it is open; :meth:`refusal` is sent where none is free."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        name = scope["state"]["actor"].name
        if _open[name] >= MOST:
            await self.refusal(f"{name} follows {MOST} logs and pages already; close some")(scope, receive, send)
            return
        _open[name] += 1
        try:
            await super().__call__(scope, receive, send)
        finally:
            _open[name] -= 1
            if not _open[name]:
                del _open[name]

    def refusal(self, message: str) -> Response:
        """The answer in place of the stream."""
        return error_response(message, 429, "TooManyRequestsException")


def pause(least: float) -> float:
    """Seconds until an answer looks again: longer where many are open, so that their number does not slow the server down."""
    return max(least, _SHARE * _open.total())


async def polled(read: Callable[[], T], calls: StoreCalls | None) -> T:
    """The result of ``read``, from a thread that serves these answers alone; one of ``calls`` where it reads the store.

    Raises what it raises, StoreSilent.
    """
    future = calls.submit(read) if calls else _reads.submit(partial(contextvars.copy_context().run, read))
    return await asyncio.wrap_future(future)


async def polled_patiently(read: Callable[[], T], calls: StoreCalls | None, seconds: float) -> AsyncIterator[T | None]:
    """:func:`polled`, and before it None whenever so many seconds have passed: the store may hang."""
    task = asyncio.ensure_future(polled(read, calls))
    try:
        while not (await asyncio.wait({task}, timeout=seconds))[0]:
            yield None
        yield task.result()
    finally:
        task.cancel()
