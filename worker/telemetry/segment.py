"""A memory segment that a training and one reader on the same machine share: the newest rows of the tap.

A file of 0600 that both map. The writer never waits: it announces how far it is about to write, writes, and announces how far it has
written. A reader copies what is written, then reads the first number again, and drops what may have been written over meanwhile.
"""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from worker.telemetry.rows import MARKS, Layout, Rows

_MAGIC = 0x4D75737465725432
_STARTED, _WRITTEN, _CLOSED = 1, 2, 3
_HEADER = 8
"""Whole numbers of 64 bits before the rows."""


class Segment:
    """Rows in shared memory: a ring of ``layout.rows`` control steps.

    Args:
        path: The file.
        layout: Of the rows.
        file: Its descriptor, open for reading and writing; it is closed here.

    Raises:
        OSError: It can't be mapped.
        ValueError: It is no such file, or one of another layout.
    """

    def __init__(self, path: Path, layout: Layout, file: int) -> None:
        self.path, self.layout = path, layout
        row = _row_type(layout)
        size = 8 * _HEADER + layout.rows * row.itemsize
        try:
            if os.fstat(file).st_size != size:
                raise ValueError(f"{path}: it is not the shared memory of such a tap")
            memory = mmap.mmap(file, size)
        finally:
            os.close(file)
        self._header = np.frombuffer(memory, np.int64, _HEADER)
        self._ring = np.frombuffer(memory, row, layout.rows, 8 * _HEADER)
        self._next = 0
        """The next row to read, counted in rows written."""
        self._step: int | None = None
        """Number of the control step that is read next."""

    @classmethod
    def create(cls, layout: Layout) -> Segment:
        """A new one, in memory where the machine has a file system for that with enough space (a container often has 64 MB). Raises OSError."""
        shared = Path("/dev/shm")
        size = 8 * _HEADER + layout.rows * _row_type(layout).itemsize
        fits = os.access(shared, os.W_OK) and shutil.disk_usage(shared).free > size
        file, name = tempfile.mkstemp(prefix="muster-tap-", dir=shared if fits else None)
        try:
            # takes the memory now: a write to a mapping that finds none is a SIGBUS
            os.posix_fallocate(file, 0, size)
        except OSError:
            os.close(file)
            os.unlink(name)
            raise
        segment = cls(Path(name), layout, file)
        segment._header[0] = _MAGIC
        return segment

    @classmethod
    def open(cls, path: Path, layout: Layout) -> Segment:
        """One that a training has created. Raises OSError, ValueError."""
        segment = cls(path, layout, os.open(path, os.O_RDWR | os.O_NOFOLLOW))
        if segment._header[0] != _MAGIC:
            raise ValueError(f"{path}: it is not the shared memory of a tap")
        return segment

    def append(self, rows: Rows) -> None:
        """Add rows; the oldest give way."""
        size = self.layout.rows
        for first in range(0, len(rows), size):
            part = slice(first, min(first + size, len(rows)))
            written = int(self._header[_WRITTEN])
            end = written + part.stop - part.start
            places = np.arange(written, end) % size
            self._header[_STARTED] = end
            self._ring["number"][places] = np.arange(rows.first + part.start, rows.first + part.stop)
            for name in ("values", "marks", "images"):
                self._ring[name][places] = getattr(rows, name)[part]
            self._header[_WRITTEN] = end

    def skip(self) -> None:
        """Read on with what is written from now on."""
        self._next, self._step = int(self._header[_WRITTEN]), None

    def take(self) -> Iterator[Rows]:
        """Copies of the rows written since the last call: runs of consecutive control steps. Overwritten rows count as lost."""
        size, written = self.layout.rows, int(self._header[_WRITTEN])
        first = max(self._next, written - size)
        taken = self._ring[np.arange(first, written) % size]
        taken = taken[max(0, int(self._header[_STARTED]) - size - first) :]
        self._next = written
        for run in np.split(taken, np.flatnonzero(np.diff(taken["number"]) != 1) + 1):
            if len(run):
                step = int(run["number"][0])
                lost = 0 if self._step is None else step - self._step
                self._step = step + len(run)
                yield Rows(self.layout, step, run["values"], run["marks"], run["images"], lost)

    def newest(self) -> Rows | None:
        """The newest control step; None where there is none since the last call. Steps between count as lost."""
        self._next = max(self._next, int(self._header[_WRITTEN]) - 1)
        return next(iter([*self.take()][-1:]), None)

    @property
    def closed(self) -> bool:
        """Whether no more rows will come."""
        return bool(self._header[_CLOSED])

    def close(self) -> None:
        """Report that no more rows will come, and give up the name."""
        self._header[_CLOSED] = 1
        self.path.unlink(missing_ok=True)


def _row_type(layout: Layout) -> np.dtype[np.void]:
    """A control step of all worlds in the ring."""
    sizes = {"values": ("f4", layout.width), "marks": ("i4", len(MARKS)), "images": ("u1", layout.image_bytes)}
    fields = [(name, kind, (layout.worlds, size)) for name, (kind, size) in sizes.items()]
    return np.dtype([("number", "i8"), *fields], align=True)
