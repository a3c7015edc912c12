"""The one view of log lines, for all who read them: a job's nodes merged by time, from any place on.

A place in the log of a job is the position in each of its nodes' logs, by ``attempt/node``. A log is read from its files
(:mod:`.log_files`), which are opened anew for each look: that is safe on NFS (no inotify, no open handles). Its newest part may also
come from memory.
"""

from __future__ import annotations

import os
import re
import time
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Protocol

from shared_store.volume.files import DamagedFile, refuse_links
from shared_store.volume.layout import Run
from shared_store.volume.log_files import CHUNK, Chunk, LogCursor, LogSegment, left_out, log_end, log_segments
from shared_store.volume.logs import LIMIT_REACHED, REPLACED, LogLine, lines_in, timestamp

Places = dict[str, int]
Key = tuple[int, int]
"""Attempt and node of a log."""

_HEAD = re.compile(r"node-([0-9]{1,9})\.log")
"""Name of a log's first file."""
_ATTEMPT = re.compile(r"[0-9]{1,9}")


def place_of(log: Key) -> str:
    """The name of a log in a place."""
    return f"{log[0]}/{log[1]}"


class Memory(Protocol):
    """The newest part of a job's logs, in memory."""

    def changed(self, since: int) -> tuple[int, Sequence[Key]]:
        """The version now, and the logs that have changed since that version; 0: all that have ever changed."""
        ...

    def read(self, log: Key, position: int, most: int) -> bytes | None:
        """Up to ``most`` bytes from ``position`` on, empty at the end; None where only the files have them."""
        ...


@dataclass
class NodeLog:
    """A reader's place in one node's log."""

    key: Key
    cursor: LogCursor
    returned: int = 0
    """Position up to which lines were returned."""
    newest: str = ""
    """The greatest time so far. Lines are merged by it, so a clock that is set back does not reorder them."""
    read: list[tuple[str, LogLine]] = field(default_factory=list)
    """Lines that were read but not returned yet, with their times for merging."""
    more: bool = False
    """Whether more may be ready to read."""
    fed: bool = False
    """Whether the last lines came from memory: a network volume may not show them in the file yet."""

    def fill(self, segments: Sequence[LogSegment], most: int, rank: int | None = None) -> None:
        """Read on in the files if every line so far has been returned."""
        if self.read:
            return
        try:
            chunk = self.cursor.read(segments, most, self.fed)
        except OSError:  # deleted meanwhile, ESTALE, or not yet visible on NFS: the next poll opens it again
            self.more = False
            return
        self.fed = self.fed and self.cursor.position == chunk.start
        self._take_up(chunk, rank)

    def feed(self, memory: Memory, most: int, rank: int | None = None) -> bool:
        """Read on in memory if every line so far has been returned; False where only the files have what follows."""
        if self.read:
            return True
        position = self.cursor.position
        data = memory.read(self.key, position, most)
        if data is not None and len(data) == most and b"\n" not in data:
            data = memory.read(self.key, position, most := CHUNK)
        if data is None:
            self.fed = False
            return False
        self.more = False
        if data:
            self.fed = True
            chunk = Chunk(position, data, len(data) == most, None, self.cursor.identity)
            self._take_up(self.cursor.take(chunk, most), rank)
        return True

    def _take_up(self, chunk: Chunk, rank: int | None) -> None:
        if chunk.left_out or chunk.replaced:
            first = next(lines_in(chunk.data, self.key, 0), None)
            self._explain(chunk, first[1].time if first else timestamp(time.time()))
        newest, read = self.newest, self.read
        for _, line in lines_in(chunk.data, self.key, chunk.start):
            if line.time > newest:
                newest = line.time
            if rank is None or line.rank == rank:
                read.append((newest, line))
        self.newest, self.more = newest, chunk.more

    def _explain(self, chunk: Chunk, stamp: str) -> None:
        """Add a line that says which part is missing."""
        text = REPLACED if chunk.replaced else left_out(*chunk.left_out, LIMIT_REACHED) if chunk.left_out else ""
        self.newest = self.newest or stamp
        self.read.append((self.newest, LogLine(self.newest, *self.key, None, "e", text, chunk.start)))

    def take(self, until: str | None = None) -> list[tuple[str, LogLine]]:
        """The lines up to that time; None: all."""
        count = len(self.read) if until is None else bisect_right(self.read, until, key=itemgetter(0))
        taken, self.read = self.read[:count], self.read[count:]
        if not self.read:
            self.returned = self.cursor.position
        elif taken:
            self.returned = taken[-1][1].position
        return taken


def merged(logs: Sequence[NodeLog]) -> tuple[list[tuple[str, LogLine]], bool]:
    """The lines that were read of several logs, in the order of their times, and whether some had to be kept back.

    Unread lines of one log may be older than read lines of another.
    """
    until = min((log.newest for log in logs if log.more), default=None)
    taken = [line for log in logs for line in log.take(until)]
    taken.sort(key=itemgetter(0))
    return taken, until is not None


@dataclass(frozen=True)
class Chosen:
    """Which lines of a job's log."""

    run: Run
    job: str
    node: int | None = None
    rank: int | None = None
    attempt: int | None = None

    def has(self, log: Key) -> bool:
        """Whether lines of this log may be chosen."""
        return self.attempt in (None, log[0]) and self.node in (None, log[1])

    def attempts(self) -> list[int]:
        """The chosen attempts that have a log. Raises OSError."""
        return [each for each in attempts_with_logs(self.run, self.job) if self.attempt in (None, each)]

    def logs(self, attempt: int | None = None) -> dict[Key, list[LogSegment]]:
        """The files of each log, by attempt and node, in this order; of one attempt, or of all. Raises OSError."""
        found: dict[Key, list[LogSegment]] = {}
        for number in self.attempts() if attempt is None else [attempt]:
            found |= {log: files for log, files in logs_of(self.run, self.job, number).items() if self.has(log)}
        return found

    def end(self) -> Places:
        """The place after the last whole line. Raises OSError."""
        return {place_of(log): log_end(segments) for log, segments in self.logs().items()}


@dataclass
class LogView:
    """Reads a job's log on, all nodes and attempts merged by time, each line once.

    Lines of one node keep their order. ``offsets`` (bytes returned of each log) is its whole state: a new view with the same offsets
    continues where the old one stopped. A line (rank None) reports deleted lines that it did not reach in time, and logs that were
    truncated or replaced.
    """

    chosen: Chosen
    offsets: Places = field(default_factory=dict)
    chunk: int = CHUNK
    """Bytes that a poll reads of a log; more where no line ends in them."""
    behind: bool = False
    """Whether there was more than the last poll returned."""
    in_files: bool = True
    """Whether the files have, or may have, what memory has not: then :meth:`poll_memory` waits for :meth:`poll`."""
    _logs: dict[Key, NodeLog] = field(default_factory=dict)
    _version: int = 0
    """Of the memory, when it was asked last which logs have changed."""
    _due: set[Key] = field(default_factory=set)
    """Logs that have changed in memory and were not read to their ends."""

    @classmethod
    def of(cls, run: Run, job: str, offsets: Places | None = None, **which: int) -> LogView:
        """The lines of a job's log, or ``which`` of them, as :class:`Chosen` has it."""
        return cls(Chosen(run, job, **which), offsets or {})

    def poll(self) -> list[LogLine]:
        """The whole lines in the files since the last call, or the first part of them, in the order of their times. Raises OSError."""
        lines: list[LogLine] = []
        self.behind = False
        for attempt in self.chosen.attempts():
            logs = []
            for key, segments in self.chosen.logs(attempt).items():
                logs.append(self._log(key))
                logs[-1].fill(segments, self.chunk, self.chosen.rank)
            lines += self._merged(logs)
            if self.behind:
                break
        self.in_files = self.behind
        return lines

    def poll_memory(self, memory: Memory, most: int) -> list[LogLine] | None:
        """:meth:`poll` without a file, up to ``most`` bytes of each log; None where only the files have what follows.

        It visits the logs that have changed alone. A view has one memory.
        """
        if self.in_files:
            return None
        self._version, changed = memory.changed(self._version)
        self._due.update(filter(self.chosen.has, changed))
        attempts: dict[int, list[NodeLog]] = {}
        for key in sorted(self._due):
            log = self._log(key)
            if not log.feed(memory, most, self.chosen.rank):
                self.in_files = True
                return None
            attempts.setdefault(key[0], []).append(log)
        lines: list[LogLine] = []
        self.behind = False
        for logs in attempts.values():
            lines += self._merged(logs)
            if self.behind:
                break
        self._due = {log.key for logs in attempts.values() for log in logs if log.more or log.read}
        return lines

    def drain(self) -> Iterator[LogLine]:
        """All lines that exist now."""
        for lines in self.batches():
            yield from lines

    def batches(self) -> Iterator[list[LogLine]]:
        """:meth:`drain`, many lines at a time."""
        self.behind = True
        while self.behind:  # a poll may skip a part with another rank's lines alone and return none
            if lines := self.poll():
                yield lines

    def _log(self, key: Key) -> NodeLog:
        if key not in self._logs:
            start = self.offsets.get(place_of(key), 0)
            self._logs[key] = NodeLog(key, LogCursor(start), start)
        return self._logs[key]

    def _merged(self, logs: Sequence[NodeLog]) -> list[LogLine]:
        taken, self.behind = merged(logs)
        self.offsets.update({place_of(log.key): log.returned for log in logs})
        return [line for _, line in taken]


def attempts_with_logs(run: Run, job: str) -> list[int]:
    """The attempts that have a log. Other files, which a job may have put there, are ignored. Raises OSError."""
    directory = run.path / "logs" / job
    try:
        refuse_links(directory, 3)
        return sorted({int(name) for name in os.listdir(directory) if _ATTEMPT.fullmatch(name)})
    except (FileNotFoundError, NotADirectoryError, DamagedFile):
        return []


def logs_of(run: Run, job: str, attempt: int) -> dict[Key, list[LogSegment]]:
    """The files of the logs of one attempt, by node. Raises OSError."""
    found = {}
    for name, segments in log_segments(run.logs(job, attempt)).items():
        if match := _HEAD.fullmatch(name):
            found[attempt, int(match[1])] = segments
    return dict(sorted(found.items()))
