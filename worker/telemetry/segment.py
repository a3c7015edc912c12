"""A memory segment that a training and one reader on the same machine share: the newest rows of the tap.

A file of 0600 that both map. The writer never waits: it announces how far it is about to write, writes, and announces how far it has
written. A reader copies what is written, then looks at the first number again, and drops what may have been written over meanwhile.
"""

from __future__ import annotations

import itertools
import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from worker.telemetry.rows import MARKS, Layout, Rows

_MAGIC = 0x4D75737465725431
_BEGUN, _WRITTEN, _CLOSED = 1, 2, 3
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
        size, worlds = layout.rows, layout.worlds
        shapes = (size, worlds, layout.width), (size, worlds, len(MARKS)), (size, worlds, layout.image_bytes)
        counts = [int(np.prod(shape)) for shape in shapes]
        lengths = 8 * _HEADER, 8 * size, 4 * counts[0], 4 * counts[1], counts[2]
        try:
            if os.fstat(file).st_size != sum(lengths):
                raise ValueError(f"{path}: it is not the shared memory of such a tap")
            self._memory = mmap.mmap(file, sum(lengths))
        finally:
            os.close(file)
        starts = np.cumsum((0, *lengths)).tolist()
        self._header = np.frombuffer(self._memory, np.int64, _HEADER)
        self._numbers = np.frombuffer(self._memory, np.int64, size, starts[1])
        self._values = np.frombuffer(self._memory, np.float32, counts[0], starts[2]).reshape(shapes[0])
        self._marks = np.frombuffer(self._memory, np.int32, counts[1], starts[3]).reshape(shapes[1])
        self._images = (
            np.frombuffer(self._memory, np.uint8, counts[2], starts[4]).reshape(shapes[2]) if counts[2] else None
        )
        self._next = 0
        """The next row to read, counted in rows written."""
        self._step: int | None = None
        """Number of the control step that is read next."""

    @classmethod
    def create(cls, layout: Layout) -> Segment:
        """A new one, in memory where the machine has a file system for that with enough space (a container often has 64 MB). Raises OSError."""
        shared = Path("/dev/shm")
        row = 8 + layout.worlds * (4 * (layout.width + len(MARKS)) + layout.image_bytes)
        size = 8 * _HEADER + layout.rows * row
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
            self._header[_BEGUN] = end
            self._numbers[places] = np.arange(rows.first + part.start, rows.first + part.stop)
            self._values[places] = rows.values[part]
            self._marks[places] = rows.marks[part]
            if self._images is not None and rows.images is not None:
                self._images[places] = rows.images[part]
            self._header[_WRITTEN] = end

    def skip(self) -> None:
        """Read on with what is written from now on."""
        self._next, self._step = int(self._header[_WRITTEN]), None

    def take(self) -> Iterator[Rows]:
        """Copies of the rows written since the last call: runs of consecutive control steps. Overwritten rows count as lost."""
        size, written = self.layout.rows, int(self._header[_WRITTEN])
        first = max(self._next, written - size)
        places = np.arange(first, written) % size
        numbers, values, marks = self._numbers[places], self._values[places], self._marks[places]
        images = None if self._images is None else self._images[places]
        whole = min(max(0, int(self._header[_BEGUN]) - size - first), len(numbers))
        self._next = written
        numbers, values, marks = numbers[whole:], values[whole:], marks[whole:]
        images = None if images is None else images[whole:]
        breaks = [0, *(np.flatnonzero(np.diff(numbers) != 1) + 1).tolist(), len(numbers)]
        for start, end in itertools.pairwise(breaks):
            if start == end:
                continue
            step = int(numbers[start])
            lost = 0 if self._step is None else step - self._step
            self._step = step + end - start
            seen = None if images is None else images[start:end]
            yield Rows(self.layout, step, values[start:end], marks[start:end], lost, seen)

    def newest(self) -> Rows | None:
        """The newest control step; None where there is none since the last call. What it passes over counts as lost."""
        self._next = max(self._next, int(self._header[_WRITTEN]) - 1)
        newest = None
        for rows in self.take():
            newest = rows
        return newest

    @property
    def closed(self) -> bool:
        """Whether no more rows will come."""
        return bool(self._header[_CLOSED])

    def close(self) -> None:
        """Say that no more rows will come, and give up the name."""
        self._header[_CLOSED] = 1
        self.path.unlink(missing_ok=True)
