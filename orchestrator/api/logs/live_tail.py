"""The live tail of logs, StartLiveTail: new lines of the requested streams, also from streams that begin later."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from orchestrator.api.http.answer_streams import MEMORY_PIECE, pause, polled
from orchestrator.api.logs import eventstream
from orchestrator.api.logs.filter import Matcher
from orchestrator.api.logs.log_events import LogEvent, is_event, milliseconds
from orchestrator.api.logs.streams import Stream, newest_streams
from orchestrator.control.controller import Controller
from orchestrator.control.log_hub import Waker
from orchestrator.control.log_tail import JobLogs
from orchestrator.control.store_calls import StoreSilent
from orchestrator.persistence.batch_models import now
from orchestrator.services.permissions import Actor
from shared_store.volume.layout import Run
from shared_store.volume.log_view import Chosen, Key, LogView
from shared_store.volume.logs import LogLine

LONGEST_SESSION = 3 * 3600.0
"""Seconds, as on AWS."""
MOST_EVENTS = 500
"""Events of one update."""
_MOST_PENDING = 10 * MOST_EVENTS
"""Events that are sent at once; of more, every n-th is kept: the client can't keep up, or nobody could read it."""
_PAUSE = 0.025
"""Seconds between two looks, while few are open."""
_BEAT = 1.0
"""Seconds after which an update without events is sent."""
_AGAIN = 1.0
"""Seconds until a store that can't be read is tried again."""
_REFRESH = 0.25
"""Seconds between two questions to the database about new streams."""
_OVERLAP = 5000
"""An attempt that ended this many milliseconds before the last query is read again: commits may be late."""

log = logging.getLogger("muster.api")


@dataclass
class _Job:
    """A job that a session follows."""

    view: LogView
    logs: JobLogs | None = None
    """None before it is followed."""
    following: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    streams: dict[Key, Stream] = field(default_factory=dict)
    """Those of its logs that belong to the session."""
    newest: dict[Key, int] = field(default_factory=dict)
    """Time of each one's newest event [ms]: times never fall within a stream."""

    @property
    def is_over(self) -> bool:
        """Whether no more lines can come, as the database had it before the files were looked at."""
        return not any(stream.live for stream in self.streams.values())

    def events(self, lines: Iterable[LogLine]) -> Iterator[LogEvent]:
        """The events of those lines that are in a stream."""
        for line in lines:
            key = line.attempt, line.node
            if key in self.streams and is_event(line):
                time = self.newest[key] = max(self.newest.get(key, 0), milliseconds(line.time))
                stream = self.streams[key]
                yield LogEvent(time, stream.file.source, line.position, line.position, stream.name, line.text)


class LiveTail:
    """The lines of streams from the moment of its making on, while its block runs.

    One thread at a time polls; the block may end meanwhile.
    """

    def __init__(
        self,
        controller: Controller,
        actor: Actor,
        groups: Collection[str],
        accepts: Callable[[str], bool],
        matches: Matcher,
    ) -> None:
        """Raises OSError.

        Args:
            controller: Whose jobs' logs are followed.
            actor: Who follows them.
            groups: Names of the log groups.
            accepts: Whether a stream belongs to the session, by its name.
            matches: Whether a line does.
        """
        self._controller, self._actor, self._groups = controller, actor, groups
        self._accepts, self._matches = accepts, matches
        self.group_of: dict[str, str] = {}
        """Group of each stream that was followed."""
        self.calls, self.waker = controller.access.followed, Waker()
        self._started = self._refreshed = now()
        self._next_refresh, self._is_due = 0.0, threading.Event()
        self._jobs: dict[str, _Job] = {}
        self._over: set[str] = set()
        """Streams that are read to their end and can get no more lines."""
        self._lock, self._is_open = threading.Lock(), False
        """Whether its block runs: only then are jobs followed, though a late poll finds new ones."""
        self._watching = contextlib.ExitStack()
        self._refresh(from_now=True)

    def __enter__(self) -> LiveTail:
        """Follow the jobs; waits for nothing."""
        with self._lock:
            self._is_open = True
            self._watching.enter_context(self._controller.logs.watch(self))
            for job in self._jobs.values():
                self._attend(job)
        self._is_due.set()  # nobody has reported what has changed since the first look
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._is_open = False
            self._watching.close()
            for job in self._jobs.values():
                job.following.close()

    def wake(self) -> None:
        """Some job has changed: there may be new streams."""
        self._is_due.set()
        self.waker.wake()

    def poll_memory(self) -> list[LogEvent] | None:
        """The events since the last call, in order; None where only the files, or the database, have them."""
        is_due = self._is_due.is_set() and time.monotonic() >= self._next_refresh
        if is_due or any(job.view.in_files for job in self._jobs.values()):
            return None
        events = list[LogEvent]()
        for job in self._jobs.values():
            if job.logs is not None:
                events += job.events(job.view.poll_memory(job.logs, MEMORY_PIECE) or ())
        return self._chosen(events)

    def poll(self) -> list[LogEvent]:
        """:meth:`poll_memory` with the files and the database. Raises OSError."""
        if self._is_due.is_set():
            self._refresh(from_now=False)
        events = list[LogEvent]()
        for job in self._jobs.values():
            if job.view.in_files:
                events += job.events(job.view.poll())
        self._leave([name for name, job in self._jobs.items() if job.is_over and not job.view.in_files])
        return self._chosen(events)

    @property
    def is_behind(self) -> bool:
        """Whether there is more already."""
        return any(job.view.in_files or job.view.behind for job in self._jobs.values())

    def _chosen(self, events: Iterable[LogEvent]) -> list[LogEvent]:
        return sorted(event for event in events if self._matches(event.text))

    def _refresh(self, *, from_now: bool) -> None:
        """Take up streams that began; those that ended before this call have their last look."""
        self._is_due.clear()
        started = now()
        with self._controller.database.session() as session:
            since = max(self._started, self._refreshed - _OVERLAP)
            streams = newest_streams(session, self._actor, self._controller.access.store, self._groups, since=since)
        self._refreshed, self._next_refresh = started, time.monotonic() + _REFRESH
        for stream in streams:
            if stream.run is not None and stream.name not in self._over and self._accepts(stream.name):
                job = self._follow(stream.run, stream.job, from_now)
                job.streams[stream.attempt, stream.node] = stream
                job.view.in_files = job.view.in_files or job.is_over
                self.group_of[stream.name] = stream.group

    def _follow(self, run: Run, job: str, from_now: bool) -> _Job:
        if job not in self._jobs:
            chosen = Chosen(run, job)
            places = chosen.end() if from_now else {}
            with self._lock:
                self._jobs[job] = _Job(LogView(chosen, places))
                if self._is_open:
                    self._attend(self._jobs[job])
        return self._jobs[job]

    def _attend(self, job: _Job) -> None:
        chosen = job.view.chosen
        job.logs = job.following.enter_context(self._controller.logs.follow(chosen.run, chosen.job, self.waker))

    def _leave(self, jobs: Iterable[str]) -> None:
        for name in jobs:
            with self._lock:
                job = self._jobs.pop(name)
                job.following.close()
            self._over.update(stream.name for stream in job.streams.values())


async def messages(
    tail: LiveTail, start: dict[str, Any], account: str, closing: threading.Event
) -> AsyncIterator[bytes]:
    """The session as event-stream messages, until ``closing``, or three hours are over.

    Args:
        tail: The session, whose block runs. It was made before: the client may write as soon as it sees the first message.
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
        except (OSError, StoreSilent) as error:  # the store is unavailable: it may come back, and nothing is lost
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
        if not tail.is_behind:
            await tail.waker.wait(max(0.0, beat - time.monotonic()))
            await asyncio.sleep(pause(_PAUSE))


async def _polled(tail: LiveTail) -> tuple[list[LogEvent], bool]:
    """The new events, from memory where that has them, else from the files; and whether some of them were left out."""
    found = await polled(tail.poll_memory, None)
    if found is None:
        found = await polled(tail.poll, tail.calls)
    if (count := len(found)) > _MOST_PENDING:  # the newest is always among them
        return [found[(place + 1) * count // _MOST_PENDING - 1] for place in range(_MOST_PENDING)], True
    return found, False


def _updates(events: list[tuple[LogEvent, str]], sampled: bool) -> Iterator[bytes]:
    """One sessionUpdate for every MOST_EVENTS events, each with its group; an empty one where there are none."""
    batches = [events[first : first + MOST_EVENTS] for first in range(0, len(events), MOST_EVENTS)] or [[]]
    return (_update(batch, sampled) for batch in batches)


def _update(events: list[tuple[LogEvent, str]], sampled: bool) -> bytes:
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
