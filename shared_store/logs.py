"""Logs: one log per node and attempt, one writer per log, lines ``<RFC 3339 UTC, µs> <rank or -> <o|e> <text>``.

Followers poll sizes and reopen the files (:mod:`.log_files`) each round, which is safe on NFS (no inotify, no open handles).
"""

from __future__ import annotations

import os
import re
import time
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from json.encoder import encode_basestring_ascii
from operator import itemgetter
from typing import NamedTuple

from shared_store.files import DamagedFile, refuse_links
from shared_store.layout import Run
from shared_store.log_files import Chunk, Segment, left_out, log_segments, read_log

_LINE = re.compile(r"(\S+) (-|\d{1,9}) ([oe]) (.*)", re.DOTALL)
LINES = re.compile(rb"^(\S+) (-|\d{1,9}) ([oe]) (.*)\n", re.MULTILINE)
"""Whole lines of a file: time, rank, stream, text."""
HEAD = re.compile(r"node-([0-9]{1,9})\.log")
"""Name of a log's first file."""
_ATTEMPT = re.compile(r"[0-9]{1,9}")
_CHUNK = 1 << 20
"""Bytes that a poll reads of a log: more than the longest line."""

LIMIT_REACHED = "the log reached its limit"
REPLACED = "the log was truncated or replaced; following continues from its new beginning"

END_LINE = "node {node} ended: {reason}"
"""The supervisor's last line: no output of the job, so CloudWatch Logs does not show it."""
OUTCOME_LINE = "muster-outcome "
"""Beginning of a supervisor's last line where its log leaves the node as text (AWS); the outcome follows as JSON."""


class LogLine(NamedTuple):
    """One line of a node's log."""

    time: str
    """RFC 3339, UTC, microseconds: ``2026-01-31T12:00:00.000000Z``; sorts as text."""
    attempt: int
    node: int
    rank: int | None
    """Global rank; None for the supervisor's own lines."""
    stream: str
    """``o`` standard output, ``e`` standard error."""
    text: str
    position: int = 0
    """Position in the log after this line (:mod:`.log_files`)."""

    def to_json(self) -> str:
        """One line of JSON, without its newline; printable ASCII only."""
        rank = "null" if self.rank is None else self.rank
        return (
            f'{{"time": {encode_basestring_ascii(self.time)}, "attempt": {self.attempt}, "node": {self.node}, "rank": {rank}, '
            f'"stream": "{self.stream}", "text": {encode_basestring_ascii(self.text)}, "position": {self.position}}}'
        )


def timestamp(seconds: float) -> str:
    """Unix time [s] as RFC 3339 UTC with microseconds."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def format_line(seconds: float, rank: int | None, stream: str, text: str) -> str:
    """One line of the file, with its newline; a newline inside ``text`` is kept as ``\\n``'s two characters."""
    return format_lines(seconds, rank, stream, [text])


def format_lines(seconds: float, rank: int | None, stream: str, texts: Iterable[str]) -> str:
    """:func:`format_line` for many lines of the same time and origin."""
    before = f"{timestamp(seconds)} {'-' if rank is None else rank} {stream} "
    return "".join([f"{before}{_escaped(text)}\n" for text in texts])


def _escaped(text: str) -> str:
    return text.replace("\r", "").replace("\n", "\\n") if "\n" in text or "\r" in text else text


def parse_line(line: str, attempt: int, node: int) -> LogLine | None:
    """The line as written by :func:`format_line`; None for any other text."""
    match = _LINE.fullmatch(line)
    if not match:
        return None
    rank = None if match[2] == "-" else int(match[2])
    return LogLine(match[1], attempt, node, rank, match[3], match[4])


@dataclass
class _Source:
    """A follower's state of one log."""

    attempt: int
    node: int
    position: int
    """Position up to which it was read."""
    given: int = 0
    """Position up to which lines were returned."""
    identity: bytes = b""
    """Beginning of the file that was read last."""
    inside: bool = False
    """Whether ``position`` is inside a line that is longer than any line of Muster's."""
    newest: str = ""
    """The greatest time so far. Lines are merged by it, so a clock that is set back does not reorder them."""
    read: list[tuple[str, LogLine]] = field(default_factory=list)
    """Lines that were read but not returned yet, with their times for merging."""
    more: bool = False
    """Whether more may be ready to read."""

    def fill(self, segments: Sequence[Segment], most: int, rank: int | None) -> None:
        """Read on if every line so far has been returned."""
        if self.read:
            return
        try:
            chunk = read_log(segments, self.position, most, self.identity, self.inside)
            if len(chunk.data) == most < _CHUNK and b"\n" not in chunk.data:
                most = _CHUNK
                chunk = read_log(segments, self.position, most, self.identity, self.inside)
        except OSError:  # deleted meanwhile, ESTALE, or not yet visible on NFS: the next poll opens it again
            self.more = False
            return
        whole = chunk.data.rfind(b"\n") + 1
        self.inside = not whole and len(chunk.data) == most
        if self.inside:
            whole = len(chunk.data)
        if chunk.left_out or chunk.replaced:
            first = LINES.search(chunk.data, 0, whole)
            self._explain(chunk, first[1].decode(errors="replace") if first else timestamp(time.time()))
        for match in LINES.finditer(chunk.data, 0, whole):
            written, number, stream, text = match.groups()
            stamp = written.decode(errors="replace")
            if stamp > self.newest:
                self.newest = stamp
            place = None if number == b"-" else int(number)
            if rank is None or place == rank:
                origin = (stamp, self.attempt, self.node, place, stream.decode())
                line = LogLine(*origin, text.decode(errors="replace"), chunk.start + match.end())
                self.read.append((self.newest, line))
        self.more = chunk.more and bool(whole)
        self.position, self.identity = chunk.start + whole, chunk.identity

    def _explain(self, chunk: Chunk, stamp: str) -> None:
        """Add a line that says which part is missing."""
        text = REPLACED if chunk.replaced else left_out(*chunk.left_out, LIMIT_REACHED) if chunk.left_out else ""
        self.newest = self.newest or stamp
        self.read.append((self.newest, LogLine(self.newest, self.attempt, self.node, None, "e", text, chunk.start)))

    def take(self, until: str | None) -> list[tuple[str, LogLine]]:
        """The lines up to that time; None: all."""
        count = len(self.read) if until is None else bisect_right(self.read, until, key=itemgetter(0))
        taken, self.read = self.read[:count], self.read[count:]
        self.given = taken[-1][1].position if taken and self.read else self.given if self.read else self.position
        return taken


@dataclass
class LogFollower:
    """Reads a job's log lines, all nodes and attempts merged by time, each line once.

    Lines of one node keep their order. ``offsets`` (bytes returned of each log) is the follower's whole state: a new one with the
    same offsets continues where the old one stopped. ``node`` and ``rank`` select. A line (rank None) reports deleted lines that the
    follower did not reach in time, and logs that were truncated or replaced.
    """

    run: Run
    job: str
    node: int | None = None
    rank: int | None = None
    attempt: int | None = None
    offsets: dict[str, int] = field(default_factory=dict)
    chunk: int = _CHUNK
    """Bytes that a poll reads of a log; more where no line ends in them."""
    behind: bool = False
    """Whether there was more than the last poll returned."""
    _sources: dict[str, _Source] = field(default_factory=dict)

    def poll(self) -> list[LogLine]:
        """The whole lines since the last call, or the first part of them, in the order of their times."""
        lines: list[LogLine] = []
        self.behind = False
        for attempt in [self.attempt] if self.attempt is not None else attempts_with_logs(self.run, self.job):
            logs = self._logs(attempt)
            for source, segments in logs:
                source.fill(segments, self.chunk, self.rank)
            # unread lines of one log may be older than read lines of another
            until = min((source.newest for source, _ in logs if source.more), default=None)
            taken = []
            for source, _ in logs:
                taken += source.take(until)
                self.offsets[f"{attempt}/{source.node}"] = source.given
            taken.sort(key=itemgetter(0))
            lines += [line for _, line in taken]
            if until is not None:
                self.behind = True
                break
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

    def _logs(self, attempt: int) -> list[tuple[_Source, list[Segment]]]:
        """The logs of one attempt, by node."""
        found = log_segments(self.run.logs(self.job, attempt))
        logs = []
        for name, segments in found.items():
            match = HEAD.fullmatch(name)
            if match and (self.node is None or int(match[1]) == self.node):
                key = f"{attempt}/{int(match[1])}"
                if key not in self._sources:
                    start = self.offsets.get(key, 0)
                    self._sources[key] = _Source(attempt, int(match[1]), start, start)
                logs.append((self._sources[key], segments))
        return sorted(logs, key=lambda log: log[0].node)


def attempts_with_logs(run: Run, job: str) -> list[int]:
    """The attempts that have a log. Other files, which a job may have put there, are ignored. Raises OSError."""
    directory = run.path / "logs" / job
    try:
        refuse_links(directory, 3)
        return sorted({int(name) for name in os.listdir(directory) if _ATTEMPT.fullmatch(name)})
    except (FileNotFoundError, NotADirectoryError, DamagedFile):
        return []
