"""The files of one node's log: a head, followed by a tail of segments; at the limit, the oldest segments are deleted.

``node-0.log`` is the head, the first half of the limit. The rest goes into ``node-0.log.<start>.<lines>``, one file after
the other: the position at which the file begins, and the number of lines between the head and it. Positions count all bytes of the
log, including deleted ones, so a reader's position stays valid. Files are only created, appended to and deleted, by one writer,
which is safe on NFS.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from shared_store.contract.node import LEAST_LOG_LIMIT, LOG_LIMIT
from shared_store.volume.files import DamagedFile, make_directory, open_regular, refuse_links

_TAIL = re.compile(r"(node-[0-9]{1,9}\.log)\.([0-9]{15})\.([0-9]{1,15})")
_HEAD = re.compile(r"node-[0-9]{1,9}\.log")
CHUNK = 1 << 20
"""Bytes that are read of a log at once: more than the longest line."""
_LEVELS = 4
"""Directories from that of a log up to its run: ``<run>/logs/<job>/<attempt>``."""
_SEGMENTS = 16
"""Files of this fraction of the limit make up the tail; half of that many are kept."""
_IDENTITY = 64
"""Bytes of a file's beginning that identify it."""
_CHECK = 1 << 20
"""Bytes between two looks at the volume's free space."""
_RESERVE = 256 << 20
"""Bytes of a volume that logs leave free; on a small volume, a fiftieth."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


class LogSegment(NamedTuple):
    """One file of a log."""

    start: int
    """Position of its first byte."""
    lines: int
    """Lines between the head and it; 0 for the head."""
    path: Path


class Identity(NamedTuple):
    """The beginning of one file: a line with its time, so another file of the same name begins differently."""

    start: int = 0
    """Position of the file's first byte."""
    head: bytes = b""
    """Its first bytes; empty: unknown."""


UNKNOWN = Identity()


class Chunk(NamedTuple):
    """A part of a log that was read."""

    start: int
    """Position of the first byte of ``data``; beyond the requested one if bytes were left out."""
    data: bytes
    more: bool
    """Whether more may follow already."""
    left_out: tuple[int | None, int] | None = None
    """Lines (None: unknown) and bytes that were deleted before the reader reached them."""
    identity: Identity = UNKNOWN
    """Of the file that was read."""
    replaced: bool = False
    """The file was truncated or replaced: ``data`` is from its new beginning."""


def log_segments(directory: Path) -> dict[str, list[LogSegment]]:
    """The regular files of every log in ``directory`` by the name of its head, in order.

    Empty if the directory does not exist or is a link.
    """
    found: dict[str, list[LogSegment]] = {}
    try:
        refuse_links(directory, _LEVELS)
        with os.scandir(directory) as entries:
            names = [entry.name for entry in entries if entry.is_file(follow_symlinks=False)]
    except (FileNotFoundError, NotADirectoryError, DamagedFile):
        return found
    for name in names:
        if match := _TAIL.fullmatch(name):
            found.setdefault(match[1], []).append(LogSegment(int(match[2]), int(match[3]), directory / name))
        elif _HEAD.fullmatch(name):
            found.setdefault(name, []).append(LogSegment(0, 0, directory / name))
    for segments in found.values():
        segments.sort()
    return found


def segments_of(path: Path) -> list[LogSegment]:
    """The files of the log whose head is ``path``, in order; empty if it has none yet."""
    return log_segments(path.parent).get(path.name, [])


def read_log(
    segments: Sequence[LogSegment],
    position: int,
    most: int,
    identity: Identity = UNKNOWN,
    inside: bool = False,
    ahead: bool = False,
) -> Chunk:
    """Up to ``most`` bytes of one file, from ``position`` on. Raises OSError, also if the file was deleted meanwhile.

    Args:
        segments: The log's files, not empty.
        position: The end of the previous chunk; 0 at first.
        most: Bytes.
        identity: Identity of the previous chunk.
        inside: Whether ``position`` is inside a line rather than at its beginning.
        ahead: Whether the file may end before ``position`` and be the same: a network volume shows it late.
    """
    place = max((place for place, segment in enumerate(segments) if segment.start <= position), default=0)
    start, _, path = segments[place]
    with open_regular(path) as file:  # reopened each time, so that a network file system shows the current state
        end, last = start + os.fstat(file.fileno()).st_size, place == len(segments) - 1
        if position >= end and not last:
            start, lines, _ = segments[place + 1]
            gap = (lines if place == 0 and position == end else None, start - position) if start > position else None
            return read_log(segments, start, most)._replace(left_out=gap)
        if position == end:
            return Chunk(position, b"", False, None, identity)
        offset = max(0, position - start)
        first = file.read(_IDENTITY)
        head = identity.head if identity.start == start else b""
        if ahead and position > end and (first.startswith(head) or head.startswith(first)):
            return Chunk(position, b"", False, None, identity)
        file.seek(max(0, offset - 1))
        before, data = file.read(min(offset, 1)), file.read(most)
        other = offset > 0 and not first.startswith(head)
        replaced = other or position > end or not (inside or before in (b"", b"\n"))
        if replaced:
            file.seek(0)
            offset, data = 0, file.read(most)
    position = start + offset
    known = first[: offset + data.rfind(b"\n") + 1]  # half a line may be taken back
    more = not last or position + len(data) < end
    return Chunk(position, data, more, None, Identity(start, known), replaced)


@dataclass
class LogCursor:
    """A reader's place in one log, which it reads as whole lines."""

    position: int = 0
    """Position up to which it was read."""
    identity: Identity = UNKNOWN
    """Of the file that was read last."""
    inside: bool = False
    """Whether ``position`` is inside a line that is longer than any line of Muster's."""

    def read(self, segments: Sequence[LogSegment], most: int = CHUNK, ahead: bool = False) -> Chunk:
        """The next whole lines, up to ``most`` bytes of them, or up to CHUNK where no line ends in these; as :func:`read_log`."""
        chunk = read_log(segments, self.position, most, self.identity, self.inside, ahead)
        if len(chunk.data) == most < CHUNK and b"\n" not in chunk.data:
            chunk = read_log(segments, self.position, most := CHUNK, self.identity, self.inside, ahead)
        return self.take(chunk, most)

    def take(self, chunk: Chunk, most: int) -> Chunk:
        """Move behind the whole lines of a chunk, which was read with ``most``; returns these alone."""
        whole = chunk.data.rfind(b"\n") + 1
        self.inside = not whole and len(chunk.data) == most
        data = chunk.data if self.inside else chunk.data[:whole]
        self.position, self.identity = chunk.start + len(data), chunk.identity
        return chunk._replace(data=data, more=chunk.more and bool(data))


def log_end(segments: Sequence[LogSegment]) -> int:
    """The position after the last whole line of a log. Raises OSError."""
    start, _, path = segments[-1]
    size = start + path.stat().st_size
    for most in (4 << 10, CHUNK):
        begin, data = piece_before(segments, size, most)
        if at := data.rfind(b"\n") + 1:
            return begin + at
    return start


def piece_before(segments: Sequence[LogSegment], place: int, most: int) -> tuple[int, bytes]:
    """Up to ``most`` bytes of one file that end at ``place``, and the position of the first one. Raises OSError."""
    start, _, path = next((each for each in reversed(segments) if each.start < place), segments[0])
    begin = max(start, place - most)
    with open_regular(path) as file:
        file.seek(max(0, begin - start))
        return begin, file.read(max(0, place - begin))


def left_out(lines: int | None, size: int, why: str) -> str:
    """The text that replaces deleted lines for a reader.

    >>> left_out(123456, 1_200_000_000, "the log reached its limit")
    '… 123,456 lines (1.2 GB) left out: the log reached its limit'
    """
    number, unit = float(size), "bytes"
    for greater in ("kB", "MB", "GB", "TB"):
        if number < 1000:
            break
        number, unit = number / 1000, greater
    amount = f"{number:.1f} {unit}" if unit != "bytes" else f"{size} bytes"
    if lines is None:
        return f"… {amount} left out: {why}"
    return f"… {lines:,} line{'s' if lines != 1 else ''} ({amount}) left out: {why}"


def count_lines(path: Path) -> int:
    """Newlines in a file; 0 if it does not exist. Reads it in blocks. Raises OSError."""
    try:
        with open(path, "rb") as file:
            return sum(block.count(b"\n") for block in iter(lambda: file.read(_CHECK), b""))
    except FileNotFoundError:
        return 0


class LogWriter:
    """Appends whole lines to a node's log and keeps it within its limit. One writer per log."""

    def __init__(self, path: Path, limit: int = LOG_LIMIT) -> None:
        """Continue or begin the log whose head is ``path``. Raises OSError; DamagedFile if a directory on the way is a link.

        ``limit``: bytes to keep, half of them from the log's beginning, half from its end. On a nearly full volume it is less: a log
        takes at most a quarter of the free space, so that it has a tail and its end is always kept.
        """
        self.path = path
        self.error: OSError | None = None
        """The reason why the last :meth:`append` did not write everything."""
        refuse_links(path.parent, _LEVELS)
        make_directory(path.parent, _LEVELS - 1)
        self._segments = segments_of(path) or [LogSegment(0, 0, path)]
        self._unchecked, self._interval = 0, 0
        last = self._segments[-1]
        self._lines = last.lines + (count_lines(last.path) if last.start else 0)
        self._open(last)
        free, reserve = self._room()
        self.limit = max(min(limit, (free - reserve) // 4), LEAST_LOG_LIMIT)
        self._mend(known=False)

    @property
    def lines(self) -> int:
        """Number of all lines ever written. Reads the head. Raises OSError."""
        return count_lines(self.path) + self._lines

    def end(self) -> int | None:
        """Position after the last byte of the file, whoever has written it; None where it can't be read now."""
        try:
            return self._segments[-1].start + os.fstat(self._file).st_size
        except OSError:
            return None

    def append(self, data: bytes) -> int:
        """Append whole lines; returns how many of their bytes are in the log, also as whole lines.

        It returns fewer if the volume is full even after the oldest segments were deleted, or can't be written; then
        :attr:`error` says why. The last 2 % of a volume (at most 256 MiB) are reserved for checkpoints, outcomes and the database.
        """
        self.error, written = None, 0
        while written < len(data):
            piece = self._piece(data, written)
            try:
                if not piece:
                    self._rotate()
                    continue
                self._check_room(len(piece))
                self._write(piece)
            except OSError as error:
                whole = min(self._mend(), len(piece))
                self._count(piece[:whole])
                written += whole
                if error.errno in _NO_ROOM and self._drop_oldest(1):
                    continue
                self.error = error
                break
            written += len(piece)
            self._count(piece)
        return written

    def sync(self) -> None:
        """Make the written lines durable. Raises OSError."""
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)

    def _piece(self, data: bytes, start: int) -> bytes:
        """The lines that still fit into the current file; empty if it is full."""
        first = self._segments[-1].start == 0
        room = (self.limit // 2 if first else self.limit // _SEGMENTS) - self._size
        most = min(room, _CHECK)
        if len(data) - start <= most:
            return data[start:] if start else data
        end = data.rfind(b"\n", start, start + max(most, 0)) + 1
        if end <= start and (self._size == 0 or room > most):
            end = data.index(b"\n", start) + 1  # one line that is longer than that
        return data[start:end] if end > start else b""

    def _open(self, segment: LogSegment) -> None:
        self._file = os.open(segment.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        self._size = os.fstat(self._file).st_size

    def _write(self, piece: bytes) -> None:
        view = memoryview(piece)
        while view:
            view = view[os.write(self._file, view) :]
        self._size += len(piece)

    def _count(self, data: bytes) -> None:
        if self._segments[-1].start:
            self._lines += data.count(b"\n")

    def _mend(self, known: bool = True) -> int:
        """Remove a partial line at the end of the file; returns the bytes of whole lines that the last write added.

        ``known``: whether the file ended with a whole line before that write.
        """
        try:
            size = os.fstat(self._file).st_size
            if known and size == self._size:
                return 0
            with open(self._segments[-1].path, "rb") as file:
                back = min(size, _CHECK)
                file.seek(size - back)
                tail = file.read(back)
            whole = size - len(tail) + tail.rfind(b"\n") + 1
            if whole < size:
                os.ftruncate(self._file, whole)  # which needs no room
        except OSError:
            return 0
        before, self._size = self._size, whole
        return max(0, whole - before)

    def _rotate(self) -> None:
        last = self._segments[-1]
        start = last.start + os.fstat(self._file).st_size
        following = LogSegment(start, self._lines, self.path.with_name(f"{self.path.name}.{start:015d}.{self._lines}"))
        before = self._file
        self._open(following)
        os.close(before)
        self._segments.append(following)
        self._drop_oldest(0, self.limit // 2 - self.limit // _SEGMENTS)

    def _drop_oldest(self, count: int, most: int | None = None) -> bool:
        """Delete that many segments of the tail, and more while it holds more than ``most`` bytes; True if any was deleted."""
        dropped = False
        while len(self._segments) > 2:
            _, oldest, *_ = self._segments
            held = self._segments[-1].start - oldest.start
            if count <= 0 and (most is None or held <= most):
                break
            with contextlib.suppress(FileNotFoundError):
                oldest.path.unlink()
            del self._segments[1]
            count, dropped = count - 1, True
        return dropped

    def _check_room(self, size: int) -> None:
        """Raises OSError (ENOSPC) on a nearly full volume, whose rest is reserved for other files."""
        self._unchecked += size
        if self._unchecked < self._interval:
            return
        free, reserve = self._room()
        if free - size < reserve:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._unchecked = 0
        self._interval = min(_CHECK, reserve // 4)

    def _room(self) -> tuple[int, int]:
        """Free bytes on the volume, and how many of them are reserved."""
        volume = os.fstatvfs(self._file)
        return volume.f_bavail * volume.f_frsize, min(_RESERVE, volume.f_blocks * volume.f_frsize // 50)
