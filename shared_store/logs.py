"""Logs: one file a node and attempt, one writer a file, one line ``<RFC 3339 UTC, µs> <rank or -> <o|e> <text>``.

Followers poll sizes and open the file anew each round, which is what works on NFS (no inotify, no kept handles).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from shared_store.layout import Run

_LINE = re.compile(r"(\S+) (-|\d+) ([oe]) (.*)", re.DOTALL)
_NODE = re.compile(r"node-(\d+)\.log")
_CHUNK = 1 << 20

OUTCOME_LINE = "muster-outcome "
"""How the last line begins that a supervisor prints where its log leaves the node as text (AWS); the outcome follows as JSON."""


@dataclass(frozen=True)
class LogLine:
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


def timestamp(seconds: float) -> str:
    """Unix time [s] as RFC 3339 UTC with microseconds."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def format_line(seconds: float, rank: int | None, stream: str, text: str) -> str:
    """One line of the file, with its newline; a newline inside ``text`` is kept as ``\\n``'s two characters."""
    escaped = text.replace("\r", "").replace("\n", "\\n")
    return f"{timestamp(seconds)} {'-' if rank is None else rank} {stream} {escaped}\n"


def parse_line(line: str, attempt: int, node: int) -> LogLine | None:
    """The line as written by :func:`format_line`; None for one that is not."""
    match = _LINE.fullmatch(line)
    if not match:
        return None
    rank = None if match[2] == "-" else int(match[2])
    return LogLine(match[1], attempt, node, rank, match[3], match[4])


@dataclass
class LogFollower:
    """Reads a job's log lines, all nodes and attempts merged by time, each line once.

    ``offsets`` (bytes read of each file) is the follower's whole state: a new one with the same offsets goes on where the old
    one stopped. ``node`` and ``rank`` select.
    """

    run: Run
    job: str
    node: int | None = None
    rank: int | None = None
    attempt: int | None = None
    offsets: dict[str, int] = field(default_factory=dict)

    def poll(self) -> list[LogLine]:
        """The whole lines that were added since the last call (at most 1 MiB a file), in the order of their times."""
        lines: list[LogLine] = []
        for attempt, node, path in self._files():
            key = f"{attempt}/{node}"
            chunk = _read_from(path, self.offsets.get(key, 0))
            whole = chunk.rfind(b"\n") + 1
            self.offsets[key] = self.offsets.get(key, 0) + whole
            for raw in chunk[:whole].decode(errors="replace").split("\n")[:-1]:
                line = parse_line(raw, attempt, node)
                if line and (self.rank is None or line.rank == self.rank):
                    lines.append(line)
        return sorted(lines, key=lambda line: (line.attempt, line.time))

    def drain(self) -> Iterator[LogLine]:
        """All that is there now."""
        before: dict[str, int] | None = None
        while before != self.offsets:  # a poll may pass over 1 MiB of another rank's lines and return none
            before = dict(self.offsets)
            yield from self.poll()

    def _files(self) -> Iterator[tuple[int, int, Path]]:
        attempts = [self.attempt] if self.attempt is not None else _attempts(self.run, self.job)
        for attempt in attempts:
            directory = self.run.logs(self.job, attempt)
            for name in sorted(os.listdir(directory)) if directory.exists() else []:
                match = _NODE.fullmatch(name)
                if match and (self.node is None or int(match[1]) == self.node):
                    yield attempt, int(match[1]), directory / name


def _attempts(run: Run, job: str) -> list[int]:
    directory = run.path / "logs" / job
    return sorted(int(name) for name in os.listdir(directory) if name.isdigit()) if directory.exists() else []


def _read_from(path: Path, offset: int) -> bytes:
    try:
        with open(path, "rb") as file:
            file.seek(offset)
            return file.read(_CHUNK)
    except OSError:
        return b""  # ESTALE or not yet visible on NFS: the next poll opens it again
