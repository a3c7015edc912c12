"""The events of one log file (a stream), by time and by byte position.

Lines carry the clock of their host, and a clock may step back. An event's time is therefore the greatest one up to its line:
times never fall, and they are the same at every look, by whoever and whichever server looks. A sparse index (one mark every
32 KiB, in memory, extended by what was added since the last look) gives that time for any position, and any time's position,
without reading the rest of the file.
"""

from __future__ import annotations

import hashlib
import os
import re
import threading
from bisect import bisect_left, bisect_right
from calendar import timegm
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, NamedTuple

_BLOCK = 32 << 10
"""Bytes between two marks."""
_LONGEST_LINE = 1 << 20
"""Bytes after which a line that has no end is cut; supervisors cut at 128 KiB."""
_ENDS = 256 << 10
"""Bytes at either end of a file that are read for its first and its last time: more than one line."""

_STAMP = rb"(?:19[7-9]\d|2[01]\d\d)-(?:0[1-9]|1[0-2])-(?:0[1-9]|[12]\d|3[01])T(?:[01]\d|2[0-3]):[0-5]\d:[0-5]\d\.\d{6}Z"
_LINE = re.compile(rb"(" + _STAMP + rb") (?:-|\d+) [oe] (.*)", re.DOTALL)
_STAMPS = re.compile(rb"^(" + _STAMP + rb") (?:-|\d+) [oe] ", re.MULTILINE)


class Event(NamedTuple):
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
        self._forget()

    def look(self) -> View:
        """What is in the file now: whole lines only. A file that is not there yet is empty. Raises OSError."""
        with self._lock:
            try:
                with open(self.path, "rb") as file:  # anew each time: what a network file system keeps honest
                    size = os.fstat(file.fileno()).st_size
                    if size < self._end:
                        self._forget()
                    file.seek(self._end)
                    while self._end < size and self._extend(file):
                        pass
            except FileNotFoundError:
                self._forget()
            return View(self, self._marks, len(self._marks), self._end, self._top)

    def _forget(self) -> None:
        self._marks: list[tuple[int, int]] = [(0, 0)]
        """Of every block: where it begins, and the greatest time before it."""
        self._end = 0
        self._top = 0

    def _extend(self, file: BinaryIO) -> bool:
        """Take up the next block; False where no whole line is left."""
        block = file.read(_BLOCK)
        if not block.endswith(b"\n"):
            block += file.readline(_LONGEST_LINE)
        if len(block) < _BLOCK + _LONGEST_LINE:
            block = block[: block.rfind(b"\n") + 1]
        if not block:
            return False
        if self._end - self._marks[-1][0] >= _BLOCK:  # looks at a growing file must not leave a mark each
            self._marks.append((self._end, self._top))
        self._top = max(self._top, _milliseconds(max(_STAMPS.findall(block), default=b"")))
        self._end += len(block)
        file.seek(self._end)
        return True


@dataclass(frozen=True)
class View:
    """A log as it was at one look."""

    file: LogFile
    marks: list[tuple[int, int]]
    """Shared with the file, which only adds to it; the first ``count`` are this view's."""
    count: int
    end: int
    """Bytes of whole lines."""
    top: int
    """The newest time [ms]; 0 where there is no event."""

    def forward(self, since: int = 0, start: int = 0) -> Iterator[Event]:
        """Events not before the time ``since`` [ms] and the byte ``start``, the oldest first. Raises OSError."""
        if since > self.top or start >= self.end:
            return
        by_time = bisect_left(self.marks, since, hi=self.count, key=lambda mark: mark[1]) - 1
        by_place = bisect_right(self.marks, start, hi=self.count, key=lambda mark: mark[0]) - 1
        for block in range(max(by_time, by_place, 0), self.count):
            for event in self._events(block):
                if event.time >= since and event.offset >= start:
                    yield event

    def backward(self, before: int | None = None, until: int | None = None) -> Iterator[Event]:
        """Events before the time ``before`` [ms] and the byte ``until``, the newest first. Raises OSError."""
        until = self.end if until is None else until
        last = bisect_left(self.marks, until, hi=self.count, key=lambda mark: mark[0]) - 1
        if before is not None:
            last = min(last, bisect_left(self.marks, before, hi=self.count, key=lambda mark: mark[1]) - 1)
        for block in range(last, -1, -1):
            for event in reversed(self._events(block)):
                if event.offset < until and (before is None or event.time < before):
                    yield event

    def _events(self, block: int) -> list[Event]:
        offset, time = self.marks[block]
        stop = self.marks[block + 1][0] if block + 1 < self.count else self.end
        events = []
        for line in _read(self.file.path, offset, stop - offset).split(b"\n"):
            end = offset + len(line) + 1
            if match := _LINE.fullmatch(line):
                time = max(time, _milliseconds(match[1]))
                text = match[2].decode(errors="replace")
                events.append(Event(time, self.file.source, offset, end, self.file.stream, text))
            offset = end
        return events


@lru_cache(maxsize=4096)
def log_file(path: Path, stream: str) -> LogFile:
    """The log at ``path``, with what is known of it from earlier looks."""
    return LogFile(path, stream)


def first_and_last(path: Path) -> tuple[int, int, int] | None:
    """First and last time [ms] and size [bytes] of a log, from its two ends alone; None without an event. Raises OSError."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            head = _STAMPS.search(file.read(_ENDS))
            file.seek(max(0, size - _ENDS))
            tail = _STAMPS.findall(file.read(_ENDS))
    except FileNotFoundError:
        return None
    if not head:
        return None
    first = _milliseconds(head[1])
    return first, max(first, _milliseconds(max(tail, default=b""))), size


def _read(path: Path, offset: int, size: int) -> bytes:
    try:
        with open(path, "rb") as file:
            file.seek(offset)
            return file.read(size)
    except FileNotFoundError:  # the run was deleted since the look
        return b""


def _milliseconds(stamp: bytes) -> int:
    """Unix time [ms] of a line's stamp; 0 for none."""
    return _seconds(stamp[:19]) * 1000 + int(stamp[20:23]) if stamp else 0


@lru_cache(maxsize=1024)
def _seconds(stamp: bytes) -> int:
    parts = re.split(rb"[-T:]", stamp)
    return timegm((*map(int, parts), 0, 0, 0))
