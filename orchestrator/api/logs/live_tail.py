"""A StartLiveTail session: lines as they are written, from every stream that is asked for, also those that begin later."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from orchestrator.api.http.following import MEMORY_PIECE, looked, pause
from orchestrator.api.logs import eventstream
from orchestrator.api.logs.events import Event, is_event, milliseconds
from orchestrator.api.logs.filter import Matcher
from orchestrator.api.logs.streams import Stream, newest_streams
from orchestrator.control.log_hub import Waker
from orchestrator.control.log_tail import JobLogs
from orchestrator.control.reconciler import Reconciler
from orchestrator.control.store_calls import StoreSilent
from orchestrator.persistence.models import now
from shared_store.layout import Run
from shared_store.log_files import segments_of
from shared_store.log_view import CHUNK, NodeLog, log_end
from shared_store.logs import LogLine

LONGEST_SESSION = 3 * 3600.0
"""Seconds, as on AWS."""
MOST_EVENTS = 500
"""Events of one update."""
_MOST_PENDING = 10 * MOST_EVENTS
"""Events that are sent at once; of more, every n-th is kept: the client can't keep up, or nobody could read it."""
_MOST_BEHIND = 4 << 20
"""Bytes of a stream that a session goes back to when its client was slow; what is older is left out."""
_PAUSE = 0.025
"""Seconds between two looks, while few are open."""
_BEAT = 1.0
"""Seconds after which an update without events is sent."""
_AGAIN = 1.0
"""Seconds until a store that can't be read is tried again."""
_REFRESH = 0.25
"""Seconds between two questions to the database about new streams."""
_OVERLAP = 5000
"""An attempt that ended this many milliseconds before the last question is asked for again: commits may be late."""

log = logging.getLogger("muster.api")


class _Tailed:
    """What a session has of one stream."""

    def __init__(self, stream: Stream, logs: JobLogs, *, from_now: bool) -> None:
        """``from_now``: without what it has already. Raises OSError."""
        self.stream, self.logs = stream, logs
        self.log = NodeLog(stream.attempt, stream.node, 0)
        self.is_ended = False
        """Whether no more lines can come, so that the next look is the last."""
        if from_now:
            view = stream.file.look()
            self.log.position, self.top = view.end, view.top
        else:
            self.top = 0

    def read(self, *, in_files: bool) -> bool:
        """Read what is new; False where only the files have it."""
        if not in_files:
            return not self.is_ended and self.log.feed(self.logs, MEMORY_PIECE)
        if segments := segments_of(self.stream.path):
            self.log.fill(segments, CHUNK)
        return True

    def skip(self) -> bool:
        """Leave out what is too far behind, in the files; whether something was. Raises OSError."""
        segments = segments_of(self.stream.path)
        least = log_end(segments) - _MOST_BEHIND if segments else 0
        if is_skipped := self.log.position < least:
            self.log.position, self.log.inside = least, True
        return is_skipped

    def event(self, line: LogLine) -> Event:
        """The event of a line; times never fall within a stream."""
        self.top = max(self.top, milliseconds(line.time))
        source = self.stream.file.source
        return Event(self.top, source, line.position, line.position, self.stream.name, line.text)


class LiveTail:
    """Follows streams from the moment of its beginning. Not for more than one thread at a time."""

    def __init__(
        self, reconciler: Reconciler, groups: Collection[str], wanted: Callable[[str], bool], matches: Matcher
    ) -> None:
        """Raises OSError.

        Args:
            reconciler: Whose jobs' logs are followed.
            groups: Names of the log groups.
            wanted: Whether a stream is asked for, by its name.
            matches: Whether a line is asked for.
        """
        self._reconciler, self._groups, self._wanted, self._matches = reconciler, groups, wanted, matches
        self.group_of: dict[str, str] = {}
        """Group of each stream that was followed."""
        self.calls, self.waker = reconciler.followed, Waker()
        self._started = self._asked = now()
        self._next_refresh, self._is_asked = 0.0, threading.Event()
        self._open: dict[str, _Tailed] = {}
        self._jobs: dict[str, tuple[AbstractContextManager[JobLogs], JobLogs]] = {}
        """The jobs that are followed."""
        self._over: set[str] = set()
        """Streams that are read to their end and can get no more lines."""
        with contextlib.ExitStack() as stack:
            stack.enter_context(reconciler.logs.watch(self))
            stack.callback(self._leave_all)
            self._refresh(from_now=True)
            self._entered = stack.pop_all()

    def wake(self) -> None:
        """Some job has changed: there may be new streams."""
        self._is_asked.set()
        self.waker.wake()

    def close(self) -> None:
        """Follow nothing any more."""
        self._entered.close()

    def is_due(self) -> bool:
        """Whether the database may have new streams."""
        return self._is_asked.is_set() and time.monotonic() >= self._next_refresh

    def poll(self, *, in_files: bool) -> tuple[list[Event], bool] | None:
        """The events since the last call, in order, and whether some were left out; None where only the files have them. Raises OSError.

        ``in_files``: whether files are read, and the database for new streams.
        """
        if in_files and self.is_due():
            self._refresh(from_now=False)
        followed = list(self._open.values())
        sampled = in_files and any([each.skip() for each in followed])
        fresh: list[Event] = []
        reading = followed
        while reading:
            if not all([each.read(in_files=in_files) for each in reading]):
                return None
            fresh += self._taken(reading)
            reading = [each for each in reading if each.log.more]
        self._leave([each for each in followed if each.is_ended])
        fresh.sort()
        if len(fresh) > _MOST_PENDING:
            count = len(fresh)  # the newest is always among them
            return [fresh[(place + 1) * count // _MOST_PENDING - 1] for place in range(_MOST_PENDING)], True
        return fresh, sampled

    def _taken(self, followed: Iterable[_Tailed]) -> list[Event]:
        events = [each.event(line) for each in followed for _, line in each.log.take() if is_event(line)]
        return [event for event in events if self._matches(event.text)]

    def _refresh(self, *, from_now: bool) -> None:
        """Take up streams that began; those that ended before this call have their last look."""
        self._is_asked.clear()
        asked = now()
        with self._reconciler.database.session() as session:
            since = max(self._started, self._asked - _OVERLAP)
            streams = newest_streams(session, self._reconciler.store, self._groups, since=since)
        self._asked, self._next_refresh = asked, time.monotonic() + _REFRESH
        for stream in streams:
            if stream.run is not None and stream.name not in self._over and self._wanted(stream.name):
                if stream.name not in self._open:
                    logs = self._follow(stream.run, stream.job)
                    self._open[stream.name] = _Tailed(stream, logs, from_now=from_now)
                    self.group_of[stream.name] = stream.group
                self._open[stream.name].is_ended = not stream.live

    def _follow(self, run: Run, job: str) -> JobLogs:
        if job not in self._jobs:
            following = self._reconciler.logs.follow(run, job, self.waker)
            self._jobs[job] = following, following.__enter__()
        return self._jobs[job][1]

    def _leave(self, ended: Sequence[_Tailed]) -> None:
        for each in ended:
            del self._open[each.stream.name]
            self._over.add(each.stream.name)
        for job in self._jobs.keys() - {each.stream.job for each in self._open.values()}:
            self._jobs.pop(job)[0].__exit__(None, None, None)

    def _leave_all(self) -> None:
        while self._jobs:
            self._jobs.popitem()[1][0].__exit__(None, None, None)


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
    over = time.monotonic() + LONGEST_SESSION
    yield eventstream.event("initial-response", {})
    yield eventstream.event("sessionStart", {**identity, **start})
    beat = time.monotonic() + _BEAT
    while not closing.is_set():
        try:
            events, sampled = await _polled(tail)
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
            beat = current + _BEAT
        await tail.waker.wait(beat - time.monotonic())
        await asyncio.sleep(pause(_PAUSE))


async def _polled(tail: LiveTail) -> tuple[list[Event], bool]:
    """The new events: from memory where that has them, else from the files."""
    if not tail.is_due() and (found := await looked(partial(tail.poll, in_files=False), None)) is not None:
        return found
    found = await looked(partial(tail.poll, in_files=True), tail.calls)
    return found or ([], False)


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
