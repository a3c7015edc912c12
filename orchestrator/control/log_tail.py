"""The tails of a followed job's logs, in memory: what nodes push, and what one reader finds in the files, for all followers.

Positions are bytes of a log. A push may be lost, doubled or come out of order: it counts where it continues what is known, is kept
where something before it is missing, and dropped where too much is missing. The file has it all.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import NamedTuple

from orchestrator import machine
from shared_store.volume.layout import Run
from shared_store.volume.log_files import CHUNK, UNKNOWN, Chunk, Identity, LogSegment, log_end, read_log
from shared_store.volume.log_view import Key, logs_of

MOST = 256 << 10
"""Bytes that are kept of a log, and of the pushes to it that came too early, for each."""
FRESH = 3.5
"""Seconds for which a node's word counts about the end of its log: it repeats it every second."""
_EARLY = 64
"""Pushes to a log that came too early and are kept: a few are overtaken, and a hostile node sends any number."""


class Found(NamedTuple):
    """What a look has found in a file after the end of its tail."""

    chunk: Chunk | None
    """None: too much to be kept, up to ``end``."""
    end: int


@dataclass
class Tail:
    """The newest part of one log."""

    start: int
    """Position of the first byte of ``data``."""
    data: bytearray = field(default_factory=bytearray)
    early: dict[int, bytes] = field(default_factory=dict)
    """Pushes that came before what precedes them, by position."""
    stated: int | None = None
    """End of the file as its node has stated it last."""
    received_at: float = float("-inf")
    """When that was [s]."""
    is_whole: bool = False
    """Whether its node has stated that nothing follows."""
    fed: bool = False
    """Whether the last bytes were pushed: a network volume may not show them in the file yet."""
    replaced: int = 0
    """Position up to which the log had been read when it was truncated or replaced."""
    identity: Identity = UNKNOWN
    inside: bool = False
    """These two as :func:`shared_store.volume.log_files.read_log` has them."""

    @property
    def end(self) -> int:
        return self.start + len(self.data)

    @property
    def has_gap(self) -> bool:
        """Whether the file has, or may have, what is not known here."""
        return bool(self.early) or (self.stated is not None and self.stated != self.end)

    def delivers(self, now: float) -> bool:
        """Whether its node tells of each change, so that the file needs no look."""
        return self.is_whole or now - self.received_at < FRESH

    def read(self, position: int, most: int) -> bytes | None:
        """Up to ``most`` bytes from ``position`` on; None where only the file has them."""
        if position < self.start or self.end < position <= self.replaced:
            return None
        return bytes(self.data[position - self.start : position - self.start + most])

    def push(self, position: int, data: bytes, most: int) -> bool:
        """Take bytes that a node has pushed; whether something is new. ``most``: bytes to keep."""
        before = self.end
        if position > before:
            self.early[position] = data
            self.trim(most)
            return False
        self.data += data[before - position :]
        for at in sorted(self.early):
            if at > self.end:
                break
            self.data += self.early.pop(at)[self.end - at :]
        self.trim(most)
        if self.end > before:
            self.fed = True
            self.stated = None if self.stated is None else max(self.stated, self.end)
        return self.end > before

    def missing(self, segments: Sequence[LogSegment]) -> Found:
        """What the file has after the end; nothing where that is not visible here yet. Raises OSError."""
        is_ahead = self.fed and (self.stated is None or self.stated >= self.end)
        chunk = read_log(segments, self.end, CHUNK, self.identity, self.inside, is_ahead)
        return Found(None, log_end(segments)) if len(chunk.data) == CHUNK and chunk.more else Found(chunk, 0)

    def take(self, found: Found, most: int) -> bool:
        """Take what the file has after the end; whether something is new."""
        if found.chunk is None:
            self.restart(found.end)
            return True
        chunk = found.chunk
        if chunk.replaced:
            self.replaced = max(self.end, self.replaced)
        if chunk.replaced or chunk.start > self.end:
            self.restart(chunk.start)
        whole = chunk.data.rfind(b"\n") + 1
        self.inside = not whole and len(chunk.data) == CHUNK
        self.identity = chunk.identity
        changed = self.push(chunk.start, chunk.data if self.inside else chunk.data[:whole], most)
        self.fed = self.fed and (not chunk.data or self.end > chunk.start + whole)
        return changed or chunk.replaced

    def restart(self, position: int) -> None:
        """Keep nothing, and go on at ``position``."""
        self.start, self.identity, self.inside, self.fed = position, UNKNOWN, False, False
        self.data.clear()
        self.early = {at: data for at, data in self.early.items() if at >= position}

    def trim(self, most: int) -> None:
        """Keep no more than a quarter above ``most`` bytes, and as many that came too early."""
        if len(self.early) > _EARLY or sum(map(len, self.early.values())) > most:
            self.early.clear()
        if (excess := len(self.data) - most) > most // 4:  # seldom: it moves what is kept
            del self.data[:excess]
            self.start += excess


class JobLogs:
    """The tails of one job's logs. Any thread may call; :meth:`poll` reads the store."""

    def __init__(self, run: Run, job: str) -> None:
        self.run, self.job = run, job
        self.attempt: int | None = None
        """Number of the open attempt; None while there is none."""
        self.nodes = 0
        """Number of its nodes."""
        self.is_over = False
        """Whether the job is over: its files get no more lines."""
        self._most = MOST
        self._lock = threading.Lock()
        self._tails: dict[Key, Tail] = {}
        self._version = 0
        """Number of changes that readers have to see."""
        self._changes = OrderedDict[Key, int]()
        """The version of each log's last change, the newest one last."""
        self._has_polled = False
        self._former: set[int] = set()
        """Attempts that were open, and whose logs were not looked at since."""

    # what followers read

    def changed(self, since: int) -> tuple[int, list[Key]]:
        """The version now, and the logs that have changed since that version; 0: all that have ever changed."""
        with self._lock:
            newer = takewhile(lambda change: change[1] > since, reversed(self._changes.items()))
            return self._version, [log for log, _ in newer]

    def read(self, log: Key, position: int, most: int) -> bytes | None:
        """Up to ``most`` bytes of a log; empty at the end, None where only the files have them."""
        with self._lock:
            tail = self._tails.get(log)
            return b"" if tail is None else tail.read(position, most)

    def __len__(self) -> int:
        """Number of logs that have a tail."""
        return len(self._tails)

    # what changes

    def keep(self, most: int) -> None:
        """Keep at most so many bytes of each log from now on, and of the pushes to it that come too early."""
        with self._lock:
            if most < self._most:
                for tail in self._tails.values():
                    tail.trim(most)
            self._most = most

    def push(self, log: Key, position: int, data: bytes) -> bool:
        """A node has pushed a part of its log; whether something is new."""
        with self._lock:
            is_new = self._has_polled and self._tails.setdefault(log, Tail(0)).push(position, data, self._most)
            return self._noted(log, is_new)

    def _noted(self, log: Key, is_changed: bool) -> bool:
        """Note that a log has changed; returns whether it has. The lock is held."""
        if is_changed:
            self._version += 1
            self._changes[log] = self._version
            self._changes.move_to_end(log)
        return is_changed

    def state(self, log: Key, end: int | None, is_whole: bool) -> bool:
        """A node has stated where its log ends (None: it does not push it); whether something is missing here."""
        with self._lock:
            if not self._has_polled:
                return False
            tail = self._tails.setdefault(log, Tail(0))
            tail.stated, tail.is_whole = end, is_whole
            tail.received_at = float("-inf") if end is None else machine.monotonic()
            return tail.has_gap

    def note(self, attempt: int | None, nodes: int) -> bool:
        """The open attempt and the number of its nodes; whether they are others than before."""
        with self._lock:
            if attempt == self.attempt:
                return False
            self._former |= {self.attempt} if self.attempt is not None else set()
            self.attempt, self.nodes = attempt, nodes
            for (number, _), tail in self._tails.items():
                if number not in self._former:
                    tail.restart(tail.end)
            return True

    def delivers(self) -> bool:
        """Whether every node of the open attempt tells of each change of its log, and nothing is missing."""
        with self._lock:
            if not self._has_polled or self._former:
                return False
            return self.attempt is None or (self._is_connected() and not any(tail.has_gap for tail in self._open()))

    def is_connected(self) -> bool:
        """Whether every node of the open attempt tells of its log."""
        with self._lock:
            return self._is_connected()

    def _is_connected(self) -> bool:
        now = machine.monotonic()
        return sum(tail.delivers(now) for tail in self._open()) >= self.nodes

    def _open(self) -> list[Tail]:
        """The tails of the open attempt."""
        return [tail for (attempt, _), tail in self._tails.items() if attempt == self.attempt]

    def poll(self) -> bool:
        """Read in the files what is missing in memory; whether something is new. Raises OSError."""
        with self._lock:
            is_first, former, attempt = not self._has_polled, set(self._former), self.attempt
        changed = is_first
        for number in sorted(former | (set() if attempt is None else {attempt})):
            for log, segments in logs_of(self.run, self.job, number).items():
                changed = self._poll_log(log, segments, is_first, number in former) or changed
        with self._lock:
            self._former -= former
            self._has_polled = True
        return changed

    def _poll_log(self, log: Key, segments: Sequence[LogSegment], is_first: bool, is_last: bool) -> bool:
        with self._lock:
            tail = self._tails.setdefault(log, Tail(0))
            if not (is_first or is_last) and tail.delivers(machine.monotonic()) and not tail.has_gap:
                return False
            known = replace(tail, data=bytearray(), start=tail.end)
        found = Found(None, log_end(segments)) if is_first else known.missing(segments)
        with self._lock:
            return self._noted(log, tail.take(found, self._most))
