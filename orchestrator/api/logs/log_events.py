"""The events of one log file (a stream), by time and by byte position.

Lines carry the clock of their host, and a clock may step back. An event's time is therefore the greatest one up to its line:
times never fall, and they are the same in every snapshot, by whichever server. A sparse index (one mark every
32 KiB, in memory, extended by what was added since the last snapshot) gives that time for any position, and any time's position,
without reading the rest of the file.
"""

from __future__ import annotations

import hashlib
import os
import re
import threading
from bisect import bisect_left, bisect_right
from calendar import timegm
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from shared_store.volume.files import DamagedFile, open_regular
from shared_store.volume.log_files import LogCursor, LogSegment, left_out, segments_of
from shared_store.volume.logs import END_LINE, LIMIT_REACHED, REPLACED, STAMP, LogLine, lines_in

_BLOCK = 32 << 10
"""Bytes between two marks."""
_MOST_SKIPPED = 64 << 20
"""Bytes without an event that one snapshot reads: a program can make its log a hole of any size."""
_ENDS = 256 << 10
"""Bytes at either end of a file that are read for its first and its last time: more than one line."""

_END = END_LINE.format(node=r"\d+", reason="")
_IS_END = re.compile(_END)
_STAMPS = re.compile(rb"^(" + STAMP + rb") (?!- o " + _END.encode() + rb")(?:-|\d+) [oe] ", re.MULTILINE)
"""Times of the lines that are events."""


class LogEvent(NamedTuple):
    """One line. Events compare by time, then stream, then position: the order in which a merge of streams gives them."""

    time: int
    """Unix milliseconds; within a stream it never falls."""
    source: int
    """Number of the stream, 24 decimal digits of a hash of its name."""
    offset: int
    """Byte in the file at which the line begins."""
    end: int
    """Byte after its newline."""
    stream: str
    """Name of the stream."""
    text: str

    @property
    def id(self) -> str:
        """56 digits, the same for ever; they sort as the events do."""
        return event_id(self.time, self.source, self.offset)


def event_id(time: int, source: int, offset: int) -> str:
    """The id of an event from what makes it unique: 14 + 24 + 18 digits."""
    return f"{time:014d}{source:024d}{offset:018d}"


class LogFile:
    """A log that one supervisor appends to. Safe to use from many threads."""

    def __init__(self, path: Path, stream: str) -> None:
        self.path, self.stream = path, stream
        self.source = int.from_bytes(hashlib.sha256(stream.encode()).digest()) % 10**24
        self._lock = threading.Lock()
        self._started, self._skipped = 0, 0
        self._forget()

    def snapshot(self) -> LogSnapshot:
        """A view of the log as it is now: whole lines only. A log that does not exist yet is empty. Raises OSError.

        A snapshot skips at most 64 MiB that hold no events; the next one continues there.
        """
        with self._lock:
            self._skipped = 0
            segments = segments_of(self.path)
            if not segments and self._end:
                self._forget()
            while segments and self._skipped < _MOST_SKIPPED:
                try:
                    if not self._extend(segments):
                        break
                except FileNotFoundError:  # deleted since it was listed
                    segments = segments_of(self.path)
            self._drop_deleted(segments)
            return LogSnapshot(
                self, segments, self._marks, len(self._marks), self._end, self._top, self._gap, self._started
            )

    def _forget(self) -> None:
        self._marks: list[tuple[int, int]] = [(0, 0)]
        """Of every block: where it begins, and the greatest time before it. A block is in one file, or it is the gap."""
        self._gap: Gap | None = None
        self._tail: tuple[int, int] | None = None
        """End of the head, and the greatest time up to there; None while there is no tail."""
        self._end = 0
        self._top = 0
        self._cursor = LogCursor()
        self._started += 1

    def _extend(self, segments: Sequence[LogSegment]) -> bool:
        """Take up the next blocks; False where no whole line is left."""
        chunk = self._cursor.read(segments)
        if chunk.replaced:
            self._forget()
            return True
        if chunk.start and any(segment.start == chunk.start for segment in segments):
            self._tail = self._tail or (self._end, self._top)
            self._mark(chunk.start)
        self._end, whole = chunk.start, len(chunk.data)
        start = 0
        while start < whole:
            stop = (chunk.data.find(b"\n", start + _BLOCK - 1, whole) + 1) or whole
            if self._end - self._marks[-1][0] >= _BLOCK:  # looks at a growing file must not leave a mark each
                self._mark(self._end)
            newest = max(_STAMPS.findall(chunk.data, start, stop), default=b"")
            self._skipped += 0 if newest else stop - start
            self._top = max(self._top, milliseconds(newest.decode()))
            self._end, start = chunk.start + stop, stop
        return bool(whole)

    def _mark(self, offset: int) -> None:
        if self._marks[-1][0] != offset:
            self._marks.append((offset, self._top))

    def _drop_deleted(self, segments: Sequence[LogSegment]) -> None:
        """Put the gap in the place of segments that are gone; a view keeps the marks that it has."""
        if self._tail is None or len(segments) < 2 or segments[1].start > self._end:
            return
        (start, top), (end, lines, _) = self._tail, segments[1]
        if end > start and (self._gap is None or end > self._gap.end):
            kept = [mark for mark in self._marks if mark[0] < start], [mark for mark in self._marks if mark[0] >= end]
            self._marks = [*kept[0], (start, top), *kept[1]]
            self._gap = Gap(start, end, lines)


class Gap(NamedTuple):
    """Lines that the log's writer deleted, behind its head."""

    start: int
    end: int
    lines: int


@dataclass(frozen=True)
class LogSnapshot:
    """A log as it was at one time."""

    file: LogFile
    segments: Sequence[LogSegment]
    marks: list[tuple[int, int]]
    """Shared with the file, which only adds to it; the first ``count`` are this view's."""
    count: int
    end: int
    """Position after the last whole line."""
    top: int
    """The newest time [ms]; 0 where there is no event."""
    gap: Gap | None
    started: int
    """Number of times that the log began: it differs from the snapshot before where the log was truncated or replaced."""

    def replaced(self) -> LogEvent:
        """The event that a follower gets when a log was truncated or replaced."""
        return LogEvent(self.top, self.file.source, 0, 0, self.file.stream, REPLACED)

    def forward(self, since: int = 0, start: int = 0) -> Iterator[LogEvent]:
        """Events not before the time ``since`` [ms] and the byte ``start``, the oldest first. Raises OSError."""
        if since > self.top or start >= self.end:
            return
        by_time = bisect_left(self.marks, since, hi=self.count, key=lambda mark: mark[1]) - 1
        by_place = bisect_right(self.marks, start, hi=self.count, key=lambda mark: mark[0]) - 1
        for block in range(max(by_time, by_place, 0), self.count):
            for event in self._events(block):
                if self.gap and event.offset == self.gap.start:  # a reader may have stopped inside it
                    event = event._replace(offset=max(event.offset, min(start, event.end)))
                if event.time >= since and start <= event.offset < event.end:
                    yield event

    def backward(self, before: int | None = None, until: int | None = None) -> Iterator[LogEvent]:
        """Events before the time ``before`` [ms] and the byte ``until``, the newest first. Raises OSError."""
        until = self.end if until is None else until
        last = bisect_left(self.marks, until, hi=self.count, key=lambda mark: mark[0]) - 1
        if before is not None:
            last = min(last, bisect_left(self.marks, before, hi=self.count, key=lambda mark: mark[1]) - 1)
        for block in range(last, -1, -1):
            for event in reversed(self._events(block)):
                if event.offset < until and (before is None or event.time < before):
                    yield event

    def _events(self, block: int) -> list[LogEvent]:
        offset, time = self.marks[block]
        stop = self.marks[block + 1][0] if block + 1 < self.count else self.end
        if self.gap and offset == self.gap.start:
            text = left_out(self.gap.lines, self.gap.end - self.gap.start, LIMIT_REACHED)
            return [LogEvent(time, self.file.source, offset, self.gap.end, self.file.stream, text)]
        events = []
        for begin, line in lines_in(self._read(offset, stop - offset), (0, 0), offset):
            if is_event(line):
                time = max(time, milliseconds(line.time))
                events.append(LogEvent(time, self.file.source, begin, line.position, self.file.stream, line.text))
        return events

    def _read(self, offset: int, size: int) -> bytes:
        start, _, path = self.segments[bisect_right(self.segments, offset, key=lambda each: each.start) - 1]
        try:
            with open_regular(path) as file:
                file.seek(offset - start)
                return file.read(size)
        except FileNotFoundError:  # deleted since the snapshot
            return b""


@lru_cache(maxsize=4096)
def log_file(path: Path, stream: str) -> LogFile:
    """The log at ``path``, with the facts known from earlier snapshots."""
    return LogFile(path, stream)


def first_and_last(path: Path) -> tuple[int, int, int] | None:
    """First and last time [ms] and size [bytes] of a log, from its two ends alone; None without an event. Raises OSError."""
    try:
        if not (segments := segments_of(path)):
            return None
        sizes = [os.stat(segment.path).st_size for segment in segments]
        with open_regular(path) as file:
            head = _STAMPS.search(file.read(_ENDS))
        with open_regular(segments[-1].path) as file:
            file.seek(max(0, sizes[-1] - _ENDS))
            tail = _STAMPS.findall(file.read(_ENDS))
    except (FileNotFoundError, DamagedFile):  # changed since it was listed
        return None
    if not head:
        return None
    first = milliseconds(head[1].decode())
    return first, max(first, milliseconds(max(tail, default=b"").decode())), sum(sizes)


def stored_bytes(path: Path) -> int:
    """Size of a log [bytes]; 0 where it has no file. Raises OSError."""
    try:
        return sum(os.stat(segment.path).st_size for segment in segments_of(path))
    except FileNotFoundError:  # deleted since it was listed
        return 0


def is_event(line: LogLine) -> bool:
    """Whether CloudWatch Logs shows a line: the supervisor's last one is not output of the job."""
    return line.rank is not None or line.stream != "o" or _IS_END.match(line.text) is None


def milliseconds(stamp: str) -> int:
    """Unix time [ms] of a line's stamp; 0 for none."""
    return _seconds(stamp[:19]) * 1000 + int(stamp[20:23]) if stamp else 0


@lru_cache(maxsize=1024)
def _seconds(stamp: str) -> int:
    parts = re.split("[-T:]", stamp)
    return timegm((*map(int, parts), 0, 0, 0))
