"""A StartLiveTail session: lines as they are written, from every stream that is asked for, also those that begin later."""

from __future__ import annotations

import asyncio
import heapq
import logging
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from typing import Any

from orchestrator.api.http.following import looked, pause
from orchestrator.api.logs import eventstream
from orchestrator.api.logs.events import Event, LogFile
from orchestrator.api.logs.filter import Matcher
from orchestrator.api.logs.streams import newest_streams
from orchestrator.control.reconciler import Reconciler
from orchestrator.control.store_calls import StoreSilent
from orchestrator.persistence.models import now

LONGEST_SESSION = 3 * 3600.0
"""Seconds, as on AWS."""
MOST_EVENTS = 500
"""Events of one update."""
_MOST_PENDING = 10 * MOST_EVENTS
"""Events that are sent at once; of more, every n-th is kept: the client can't keep up, or nobody could read it."""
_MOST_BEHIND = 4 << 20
"""Bytes of a stream that a session goes back to when its client was slow; what is older is left out."""
_POLL = 0.025
"""Seconds between two looks at the files; longer where a look takes longer than a quarter of that."""
_AGAIN = 1.0
"""Seconds until a store that can't be read is tried again."""
_REFRESH = 0.25
"""Seconds between two questions to the database about new streams."""
_OVERLAP = 5000
"""An attempt that ended this many milliseconds before the last question is asked for again: commits may be late."""

log = logging.getLogger("muster.api")


class LiveTail:
    """Follows streams from the moment of its construction. Not for more than one thread at a time."""

    def __init__(
        self, reconciler: Reconciler, groups: Collection[str], wanted: Callable[[str], bool], matches: Matcher
    ) -> None:
        """Args:
        controller: Whose jobs' logs are followed.
        groups: Names of the log groups.
        wanted: Whether a stream is asked for, by its name.
        matches: Whether a line is asked for.
        """
        self._reconciler, self._groups, self._wanted, self._matches = reconciler, groups, wanted, matches
        self.group_of: dict[str, str] = {}
        """Group of each stream that was followed."""
        self.calls = reconciler.followed
        self._started = self._asked = now()
        self._next_refresh = 0.0
        self._read: dict[str, int] = {}
        """Bytes of each stream that were looked through."""
        self._begun: dict[str, int] = {}
        """Each stream's number of beginnings when it was looked at last."""
        self._open: dict[str, LogFile] = {}
        self._over: set[str] = set()
        """Streams that are read to their end and can get no more lines."""
        self._refresh()
        for name, file in self._open.items():
            view = file.look()
            self._read[name], self._begun[name] = view.end, view.begun

    def poll(self) -> tuple[list[Event], bool]:
        """The events since the last call, in order, and whether some were left out. Raises OSError."""
        ended = self._refresh() if time.monotonic() >= self._next_refresh else []
        fresh, behind = [], False
        for name, file in self._open.items():
            view = file.look()
            start = self._read.get(name, 0)
            told = []
            if self._begun.setdefault(name, view.begun) != view.begun:
                start, told, self._begun[name] = 0, [view.replaced()], view.begun
            behind = behind or view.end - start > _MOST_BEHIND
            events = view.forward(0, max(start, view.end - _MOST_BEHIND))
            fresh.append([*told, *(event for event in events if self._matches(event.text))])
            self._read[name] = view.end
        for name in ended:
            self._open.pop(name)
            self._read.pop(name, None)
            self._begun.pop(name, None)
            self._over.add(name)
        merged = list(heapq.merge(*fresh))
        if len(merged) > _MOST_PENDING:
            count = len(merged)  # the newest is always among them
            return [merged[(place + 1) * count // _MOST_PENDING - 1] for place in range(_MOST_PENDING)], True
        return merged, behind

    def _refresh(self) -> list[str]:
        """Take up streams that began; returns the names of those that ended before this call: the next look is their last."""
        asked = now()
        with self._reconciler.database.session() as session:
            since = max(self._started, self._asked - _OVERLAP)
            streams = newest_streams(session, self._reconciler.store, self._groups, since=since)
        self._asked, self._next_refresh = asked, time.monotonic() + _REFRESH
        found = [stream for stream in streams if stream.name not in self._over and self._wanted(stream.name)]
        self._open.update({stream.name: stream.file for stream in found})
        self.group_of.update({stream.name: stream.group for stream in found})
        return [stream.name for stream in found if not stream.live]


async def messages(
    tail: LiveTail, start: dict[str, Any], account: str, closing: threading.Event
) -> AsyncIterator[bytes]:
    """The session as event-stream messages, until ``closing``, or three hours are over.

    Args:
        tail: The session, which has begun already: the client may write as soon as it sees the first message.
        start: The request, which ``sessionStart`` repeats.
        account: Of the log groups.
        closing: Set when the server ends.
    """
    identity = {"requestId": str(uuid.uuid4()), "sessionId": str(uuid.uuid4())}
    yield eventstream.event("initial-response", {})
    yield eventstream.event("sessionStart", {**identity, **start})
    over = time.monotonic() + LONGEST_SESSION
    beat = time.monotonic() + 1.0
    while not closing.is_set():
        before = time.monotonic()
        try:
            events, sampled = await looked(tail.poll, tail.calls)
        except (OSError, StoreSilent) as error:  # the store is away: it may come back, and nothing is lost
            log.warning("live tail: %s", error)
            events, sampled = [], False
            await asyncio.sleep(_AGAIN)
        except Exception:
            log.exception("a live tail failed")
            yield eventstream.exception("SessionStreamingException", "the controller's log has the details")
            return
        current = time.monotonic()
        if current >= over:
            yield eventstream.exception("SessionTimeoutException", "the session was open for three hours")
            return
        if events or current >= beat:
            identified = [(event, f"{account}:{tail.group_of[event.stream]}") for event in events]
            for update in _updates(identified, sampled):
                yield update
            beat = current + 1.0
        await asyncio.sleep(max(pause(_POLL), 4 * (current - before)))


def _updates(events: list[tuple[Event, str]], sampled: bool) -> Iterator[bytes]:
    """One sessionUpdate for every MOST_EVENTS events, each with its group; an empty one where there are none."""
    batches = [events[first : first + MOST_EVENTS] for first in range(0, len(events), MOST_EVENTS)] or [[]]
    return (_update(batch, sampled) for batch in batches)


def _update(events: list[tuple[Event, str]], sampled: bool) -> bytes:
    results = [
        {
            "logStreamName": event.stream,
            "logGroupIdentifier": group,
            "message": event.text,
            "timestamp": event.time,
            "ingestionTime": event.time,
        }
        for event, group in events
    ]
    return eventstream.event("sessionUpdate", {"sessionMetadata": {"sampled": sampled}, "sessionResults": results})
