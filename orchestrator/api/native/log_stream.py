"""The lines of a job's log as a stream of JSON lines: those that are there, or as they come."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator, Sequence

from orchestrator.api.http.answer_streams import MEMORY_PIECE, pause, polled, polled_patiently
from orchestrator.control.log_hub import LogHub, Waker
from orchestrator.control.log_tail import JobLogs
from orchestrator.control.store_calls import StoreCalls, StoreSilent
from orchestrator.domain.errors import ClientError
from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import LogLine, timestamp

_PAUSE = 0.025
"""Seconds between two pieces of a log that is followed, while few are."""
_AGAIN = 1.0
"""Seconds until a store that can't be read is tried again."""
_LATER = 0.25
"""Seconds until a file is tried again that does not show yet what was written to it."""
_PATIENCE = 30.0
"""Seconds for which a log that is not followed may keep its reader waiting."""
_HEARTBEAT = 5.0
"""Seconds after which an idle stream sends an empty line, which is how a client that left is noticed."""


def positions_of(text: str) -> dict[str, int]:
    """Raises ClientError."""
    try:
        positions = json.loads(text)
        if all(isinstance(position, int) and 0 <= position < 2**63 for position in positions.values()):
            return dict(positions)
    except (ValueError, AttributeError, RecursionError):
        pass
    raise ClientError('positions: expected a JSON object such as {"1/0": 4096}')


async def stored(view: LogView, calls: StoreCalls) -> AsyncIterator[str]:
    """All that is there, many lines at a time: each piece costs a hand-over between threads."""
    pieces = map(_json_lines, view.batches())  # on the thread: many may begin at once
    try:
        while (lines := await asyncio.wait_for(polled(lambda: next(pieces, None), calls), _PATIENCE)) is not None:
            yield lines
    except TimeoutError:
        yield _trouble(OSError(f"the store has not answered for {_PATIENCE:.0f} s"))
    except (OSError, ValueError, StoreSilent) as error:
        yield _trouble(error)


async def followed(view: LogView, hub: LogHub, calls: StoreCalls, closing: threading.Event) -> AsyncIterator[str]:
    """Lines as they come, until the job is over: from memory, and from the files what is not there."""
    waker = Waker()
    with hub.follow(view.chosen.run, view.chosen.job, waker) as logs:
        async for lines in _lines(view, logs, waker, calls, closing):
            yield lines
    if logs.is_over and not closing.is_set():
        async for lines in stored(view, calls):
            yield lines


async def _lines(
    view: LogView, logs: JobLogs, waker: Waker, calls: StoreCalls, closing: threading.Event
) -> AsyncIterator[str]:
    """The lines until the job is over or the server ends, and an empty one now and then."""
    spoken = time.monotonic()
    while not closing.is_set() and not logs.is_over:
        found = view.poll_memory(logs, MEMORY_PIECE)
        lines = _json_lines(found or ())
        if found is None:
            try:
                async for read in polled_patiently(lambda: _json_lines(view.poll()), calls, _HEARTBEAT):
                    if read is None:
                        yield "\n"
                    lines = read or ""
                if not lines and not view.behind:
                    await asyncio.sleep(_LATER)
            except StoreSilent:  # it may come back, and nothing is lost
                await asyncio.sleep(_AGAIN)
            except (OSError, ValueError) as error:
                yield _trouble(error)
                return
        if lines or time.monotonic() - spoken > _HEARTBEAT:
            yield lines or "\n"
            spoken = time.monotonic()
        if found is not None and not view.behind:
            await waker.wait(max(0.0, spoken + _HEARTBEAT - time.monotonic()))
            await asyncio.sleep(pause(_PAUSE))


def _trouble(error: Exception) -> str:
    """The last line of a stream that can't continue: of no node and no attempt."""
    text = f"the log can't be read now: {excerpt(' '.join(str(error).split()), LONGEST_REASON)}"
    return _json_lines([LogLine(timestamp(time.time()), 0, 0, None, "e", text)])


def _json_lines(lines: Sequence[LogLine]) -> str:
    return "".join([f"{line.to_json()}\n" for line in lines])
