"""Live parts of pages: events from the server (server-sent events), which continue where a browser lost them."""

from __future__ import annotations

import asyncio
import json
import re
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
from orchestrator.api.http.answer_streams import Following, polled_patiently
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.console.pages import session, shared, templates
from orchestrator.control.store_calls import StoreCalls
from orchestrator.domain.errors import ClientError, Unavailable
from shared_store.volume.files import DamagedFile

INTERVAL = 0.5
"""Seconds between two polls."""
_HEARTBEAT = 10.0
"""Seconds after which an idle stream sends a comment: that reveals a browser that has left."""
_PATIENCE = 5.0
"""Seconds that a poll may take until the page says so."""
_SILENT = f"the store or the database has not answered for {_PATIENCE:.0f} s; the page goes on when it does"
_LONGEST = 300.0
"""Seconds after which a stream ends; the browser reconnects at once, and is admitted again or refused."""
_MOST_KEPT = 64
_REST, _LONGEST_REST = 4.0, 5.0
"""Times as long as a value took to compute it is kept, where that is longer than its time; and the limit of that [s]."""
_AGE = re.compile(r"(?<= data-since>)[^<]*")
"""How long something is past: the page itself renews that."""
_Value = TypeVar("_Value")


@dataclass(frozen=True)
class ServerSentEvent:
    """One event: its name, its data (JSON), and its id, which a browser sends when it reconnects."""

    name: str
    data: Any
    id: str | None = None


Poll = Callable[[], Sequence[ServerSentEvent] | None]
"""The events since the last call; None at the end of the stream. Runs in a thread, where the database may be used."""


def last_id(request: Request) -> str:
    """The id of the last event that the browser has: its own header, or ``last`` in the query of one that paused; else empty."""
    return request.headers.get("last-event-id") or request.query_params.get("last", "")


def stream(
    request: Request,
    poll: Poll,
    interval: float = INTERVAL,
    *,
    stored: bool = False,
    during: AbstractContextManager[object] | None = None,
) -> StreamingResponse:
    """The events that ``poll`` finds, every ``interval`` seconds, until it returns None or the server ends; ``stored``: it reads the store.

    ``during``: a block around all polls.

    It also ends where its reader would not be admitted any more: a deleted key, an expired session. The browser comes back, and is
    sent to the login.
    """
    actor = actor_of(request)
    access: Access = request.app.state.access
    token = "" if "authorization" in request.headers else session(request)

    def admitted() -> bool:
        return access.still_admits(actor, token)

    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no", "Cross-Origin-Resource-Policy": "same-origin"}
    calls = controller_of(request).access.followed if stored else None
    events = _within(during or nullcontext(), _events(poll, calls, interval, admitted, request.app.state.closing))
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
    poll: Poll, calls: StoreCalls | None, interval: float, admitted: Callable[[], bool], closing: threading.Event
) -> AsyncGenerator[bytes, None]:
    start = last_sent = time.monotonic()
    is_troubled, found = False, None

    def goes_on() -> bool:
        return not closing.is_set() and time.monotonic() - start < _LONGEST and admitted()

    yield format_sse_event(retry=1000, comment="Muster")
    while goes_on():
        try:
            async for result in polled_patiently(lambda: (poll(),), calls, _PATIENCE):
                if result is not None:
                    (found,) = result
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
            last_sent = time.monotonic()
        elif time.monotonic() - last_sent > _HEARTBEAT:
            yield format_sse_event(comment="still here")
            last_sent = time.monotonic()
        await asyncio.sleep(interval)


def _written(event: ServerSentEvent) -> bytes:
    # ASCII: a line separator of Unicode would be one of the protocol's for some readers
    return format_sse_event(data_str=json.dumps(event.data, separators=(",", ":")), event=event.name, id=event.id)


class Table(dict[str, Any]):
    """The rows of a live table by their keys, in their order."""


class LiveParts:
    """The live parts of one page, rendered by the macros with which the page itself was rendered, and what the page has been sent of them."""

    def __init__(self, request: Request, template: str, **values: Any) -> None:
        """``template``: has a macro for each part, named like the part's id; ``values``: what it needs beside a part's own."""
        self._macros = templates.get_template(template).make_module(shared(request) | values)
        self._sent: dict[str, dict[str, tuple[Any, str]]] = {}
        """By part, and by row of a table, its value and its markup."""

    def changes(self, parts: Mapping[str, Any]) -> list[ServerSentEvent]:
        """One event ``parts``, or none: by id, the markup of each part that changed.

        Of a :class:`Table` these are ``rows``, the markup of each changed row by its key, and ``order``, all keys where their order changed.
        The part ``page`` is the text of the page's ``data-page``: a page with another one is loaded again.
        """
        data: dict[str, Any] = {}
        for name, value in parts.items():
            before, sent = self._sent.get(name), dict[str, tuple[Any, str]]()
            render, changed = str if name == "page" else getattr(self._macros, name), dict[str, str]()
            for key, row in (value if isinstance(value, Table) else {"": value}).items():
                known = before.get(key) if before else None
                markup = known[1] if known and known[0] == row else _AGE.sub("", render(row))
                if known is None or markup != known[1]:
                    changed[key] = markup
                sent[key] = row, markup
            self._sent[name] = sent
            if not isinstance(value, Table):
                data |= {name: changed[""]} if changed else {}
            elif before is None or list(before) != list(sent):
                data[name] = {"order": list(sent), "rows": changed}
            elif changed:
                data[name] = {"rows": changed}
        return [ServerSentEvent("parts", data)] if data else []


class Recent:
    """Values that many open pages need at once: each is computed at most once in ``seconds``, and for at most a fifth of the time.

    Any thread may call.

    ``most``: number of values; beyond it the one goes that was requested longest ago.
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
