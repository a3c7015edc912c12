"""Live parts of pages: events from the server (server-sent events), which continue where a browser lost them."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections import OrderedDict
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, aclosing, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

from fastapi import Request
from fastapi.responses import Response, StreamingResponse
from fastapi.sse import format_sse_event

from orchestrator.api.http.access import Access
from orchestrator.api.http.answer_streams import Following, looked_patiently
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.console.pages import session
from orchestrator.control.store_calls import StoreCalls
from orchestrator.domain.errors import ClientError, Unavailable
from shared_store.volume.files import DamagedFile

INTERVAL = 0.5
"""Seconds between two looks."""
_HEARTBEAT = 10.0
"""Seconds after which an idle stream sends a comment: that reveals a browser that has left."""
_PATIENCE = 5.0
"""Seconds for which a look may take until the page says so."""
_SILENT = f"the store or the database has not answered for {_PATIENCE:.0f} s; the page goes on when it does"
_LONGEST = 300.0
"""Seconds after which a stream ends; the browser reconnects at once, and is admitted again or refused."""
_MOST_KEPT = 64
_REST, _LONGEST_REST = 4.0, 5.0
"""Times as long as a value took to compute it is kept, where that is longer than its time; and the limit of that [s]."""
_Value = TypeVar("_Value")


@dataclass(frozen=True)
class ServerSentEvent:
    """One event: its name, its data (JSON), and its id, which a browser sends when it reconnects."""

    name: str
    data: Any
    id: str | None = None


Look = Callable[[], Sequence[ServerSentEvent] | None]
"""The events since the last call; None at the end of the stream. Runs in a thread, where the database may be used."""


def last_id(request: Request) -> str:
    """The id of the last event that the browser has: its own header, or ``last`` in the query of one that paused; else empty."""
    return request.headers.get("last-event-id") or request.query_params.get("last", "")


def stream(
    request: Request,
    look: Look,
    interval: float = INTERVAL,
    *,
    stored: bool = False,
    during: AbstractContextManager[object] | None = None,
) -> StreamingResponse:
    """The events that ``look`` finds, every ``interval`` seconds, until it returns None or the server ends; ``stored``: it reads the store.

    ``during``: a block around all looks.

    It also ends where its reader would not be admitted any more: a deleted key, a session that is over. The browser comes back, and is
    sent to the login.
    """
    actor = actor_of(request)
    access: Access = request.app.state.access
    given = "" if "authorization" in request.headers else session(request)

    def admitted() -> bool:
        return access.still_admits(actor, given)

    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no", "Cross-Origin-Resource-Policy": "same-origin"}
    calls = controller_of(request).access.followed if stored else None
    events = _within(during or nullcontext(), _events(look, calls, interval, admitted, request.app.state.closing))
    return _Live(events, media_type="text/event-stream", headers=headers)


class _Live(Following):
    def refusal(self, message: str) -> Response:
        trouble = _written(ServerSentEvent("trouble", f"{message}, and this one becomes live"))
        return Response(format_sse_event(retry=30_000, comment="Muster") + trouble, media_type=self.media_type)


async def _within(block: AbstractContextManager[object], events: AsyncGenerator[bytes, None]) -> AsyncIterator[bytes]:
    with block:
        async with aclosing(events):
            async for each in events:
                yield each


async def _events(
    look: Look, calls: StoreCalls | None, interval: float, admitted: Callable[[], bool], closing: threading.Event
) -> AsyncGenerator[bytes, None]:
    begun = spoken = time.monotonic()
    is_troubled, found = False, None

    def goes_on() -> bool:
        return not closing.is_set() and time.monotonic() - begun < _LONGEST and admitted()

    yield format_sse_event(retry=1000, comment="Muster")
    while goes_on():
        try:
            async for answer in looked_patiently(lambda: (look(),), calls, _PATIENCE):
                if answer is not None:
                    (found,) = answer
                elif goes_on():
                    is_troubled = True
                    yield _written(ServerSentEvent("trouble", _SILENT))
                else:
                    return
        except (ClientError, Unavailable, DamagedFile, OSError) as error:
            is_troubled = True
            yield _written(ServerSentEvent("trouble", str(error)))
            await asyncio.sleep(5 * interval)
            continue
        if is_troubled:
            is_troubled = False
            yield _written(ServerSentEvent("trouble", ""))
        if found is None:
            yield _written(ServerSentEvent("end", None))
            return
        if found:
            yield b"".join(map(_written, found))
            spoken = time.monotonic()
        elif time.monotonic() - spoken > _HEARTBEAT:
            yield format_sse_event(comment="still here")
            spoken = time.monotonic()
        await asyncio.sleep(interval)


def _written(event: ServerSentEvent) -> bytes:
    # ASCII: a line separator of Unicode would be one of the protocol's for some readers
    return format_sse_event(data_str=json.dumps(event.data, separators=(",", ":")), event=event.name, id=event.id)


class TableRows:
    """The rows of a live table, and their changes since the last look, by key and field."""

    def __init__(self, name: str = "rows") -> None:
        """``name``: of its events; a page with several tables has one of each."""
        self._name = name
        self._order: list[str] | None = None
        self._shown: dict[str, Mapping[str, Any]] = {}
        self._totals: Mapping[str, Any] = {}

    def changes(self, rows: Mapping[str, Mapping[str, Any]], totals: Mapping[str, Any]) -> list[ServerSentEvent]:
        """One event, or none: the order of the keys, where it changed, and the changed fields of each row; ``totals`` of the whole page.

        Args:
            rows: Key of each row, in their order, and its fields as texts.
            totals: Fields that belong to no row.
        """
        order = list(rows)
        data: dict[str, Any] = {}
        if order != self._order:
            data["order"] = order
        changed = {key: _difference(self._shown.get(key), row) for key, row in rows.items()}
        if found := {key: fields for key, fields in changed.items() if fields}:
            data["rows"] = found
        if totals != self._totals:
            data["totals"] = totals
        self._order, self._shown, self._totals = order, dict(rows), totals
        return [ServerSentEvent(self._name, data)] if data else []


def _difference(before: Mapping[str, Any] | None, after: Mapping[str, Any]) -> Mapping[str, Any]:
    return after if before is None else {name: value for name, value in after.items() if before.get(name) != value}


class Recent:
    """Values that many open pages need at once: each is computed at most once in ``seconds``, and for at most a fifth of the time.

    Any thread may call.

    ``most``: number of values; beyond it the one goes that was asked for longest ago.
    """

    def __init__(self, seconds: float = INTERVAL * 0.9, most: int = _MOST_KEPT) -> None:
        self._seconds, self._most, self._lock = seconds, most, threading.Lock()
        self._kept: OrderedDict[Hashable, tuple[threading.Lock, list[tuple[float, Any]]]] = OrderedDict()
        """By key its lock, and the value with the moment until which it is kept."""

    def get(self, key: Hashable, compute: Callable[[], _Value]) -> _Value:
        """The value of ``key``; where it is older, of ``compute``, which one caller runs while others wait."""
        with self._lock:
            lock, kept = self._kept.setdefault(key, (threading.Lock(), []))
            self._kept.move_to_end(key)
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        with lock:
            now = time.monotonic()
            if not kept or now >= kept[0][0]:
                value = compute()
                done = time.monotonic()
                kept[:] = [(max(now + self._seconds, done + min(_REST * (done - now), _LONGEST_REST)), value)]
                return value
            known: _Value = kept[0][1]
            return known
