"""The rows of the tap, one for each world and control step, and the memory that a training and one reader on the same machine share.

The shared memory is a file of 0600 that both map. The writer never waits: it announces how far it is about to write, writes, and announces
how far it has written. A reader copies what is written, then reads the first number again, and drops what may have been written over
meanwhile.
"""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from shared_store.contract.error_text import counted

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


MARKS = ("episode", "age", "done", "time_out", "cause")
"""Whole numbers of a row: how many episodes of the world have ended before this step since the tap began, steps on the clock after the
step (0 where the next episode has begun), whether the step ended an episode, whether by the clock alone, and of the episode that ended
last the cause, an index into ``Layout.causes``."""


@dataclass(frozen=True)
class Layout:
    """The columns of a row, float32: joint coordinates, joint velocities, observations, actions, reward terms, the reward.

    Everything is as it is after the step: where the step ended an episode, coordinates, velocities and observations are already those
    with which the next one begins, while actions, terms and reward belong to the one that ended.

    Attributes:
        worlds: How many worlds are watched: the first ones.
        rows: Control steps that a ring holds.
        coordinates: Joint coordinates of a world [m, rad, quaternion xyzw].
        dofs: Joint velocities of a world [m/s, rad/s].
        observations: Names, those of ``Task.states``.
        actions: Names.
        terms: Names of the reward terms.
        control_hz: Control steps of a simulated second.
        images: The observation groups of images that are kept: name, channels (3: red, green and blue; 1), height and width [px].
        causes: Names of what can end an episode, see :class:`worker.tasks.run.episode_records.LastEpisodes`.
    """

    worlds: int
    rows: int
    coordinates: int
    dofs: int
    observations: tuple[str, ...]
    actions: tuple[str, ...]
    terms: tuple[str, ...]
    control_hz: float
    images: tuple[tuple[str, int, int, int], ...] = ()
    causes: tuple[str, ...] = ()

    @classmethod
    def of(cls, task: Task, worlds: int, rows: int, images: bool = True) -> Layout:
        """That of a task's first ``worlds`` worlds, with the images of its cameras or without."""
        arrays = task.worlds.arrays
        shapes = {name: tensor.shape[1:] for name, tensor in task.groups.items() if images and tensor.ndim == 4}
        return cls(
            worlds,
            rows,
            arrays.joint_q.shape[1],
            arrays.joint_qd.shape[1],
            tuple(task.observation_names),
            ("choice",) if task.discrete else tuple(task.action_names),
            tuple(task.reward_terms),
            task.config.control_hz,
            # the present frame comes first; of masks and the like that are not colours, the first channel is shown
            tuple((name, 3 if shape[0] % 3 == 0 else 1, shape[1], shape[2]) for name, shape in shapes.items()),
            tuple(task.ended.names),
        )

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Layout:
        """A layout from :func:`dataclasses.asdict` and JSON."""
        names = {name: tuple(value[name]) for name in ("observations", "actions", "terms", "causes")}
        return cls(**{**value, **names, "images": tuple(map(tuple, value["images"]))})

    @property
    def ends(self) -> tuple[int, ...]:
        """The column behind each of the six parts, in order."""
        sizes = (self.coordinates, self.dofs, len(self.observations), len(self.actions), len(self.terms), 1)
        return tuple(accumulate(sizes))

    @property
    def width(self) -> int:
        """Columns of a row."""
        return self.ends[-1]

    @property
    def image_bytes(self) -> int:
        """Bytes of the images of a world in one control step."""
        return sum(channels * height * width for _, channels, height, width in self.images)


@dataclass(frozen=True)
class Rows:
    """Some control steps of the watched worlds, the oldest first.

    Attributes:
        layout: What the columns are.
        first: Number of the first step since the tap began.
        values: Shape ``(steps, worlds, layout.width)``, float32.
        marks: Shape ``(steps, worlds, len(MARKS))``, int32.
        images: The present frames of ``layout.images`` one after the other, shape ``(steps, worlds, layout.image_bytes)``, uint8.
        lost: Steps before ``first`` that were overwritten before they were read.
    """

    layout: Layout
    first: int
    values: np.ndarray
    marks: np.ndarray
    images: np.ndarray
    lost: int = 0

    def __len__(self) -> int:
        return len(self.values)

    def _part(self, number: int) -> np.ndarray:
        ends = (0, *self.layout.ends)
        return self.values[:, :, ends[number] : ends[number + 1]]

    coordinates = property(lambda self: self._part(0))
    """Joint coordinates, shape ``(steps, worlds, coordinates)``."""
    velocities = property(lambda self: self._part(1))
    """Joint velocities, shape ``(steps, worlds, dofs)``."""
    observations = property(lambda self: self._part(2))
    """Observations after the step, shape ``(steps, worlds, observations)``."""
    actions = property(lambda self: self._part(3))
    """The policy's actions, shape ``(steps, worlds, actions)``."""
    terms = property(lambda self: self._part(4))
    """Weighted reward terms, shape ``(steps, worlds, terms)``."""
    rewards = property(lambda self: self._part(5)[:, :, 0])
    """Shape ``(steps, worlds)``."""

    def mark(self, name: str) -> np.ndarray:
        """One of :data:`MARKS`, shape ``(steps, worlds)``."""
        return self.marks[:, :, MARKS.index(name)]

    def cause(self, step: int, world: int) -> str:
        """Cause of the end of the episode that ended in this step; in any other step, of the world's last episode."""
        return self.layout.causes[int(self.mark("cause")[step, world])]

    def end_of_episode(self, step: int, world: int, number: int, total: float, length: int) -> str:
        """A line about the episode ``number`` of a world that ended in this step, with its return and its length [control steps]."""
        cause = self.cause(step, world)
        return f"world {world}: episode {number} ended by {cause} after {counted(length, 'step')}, return {total:.4g}"

    def pictures(self, step: int) -> dict[str, np.ndarray]:
        """The image of each camera after a step, by its group: uint8, ``(worlds, height, width, 3)`` or ``(worlds, height, width)``."""
        found: dict[str, np.ndarray] = {}
        start = 0
        for name, channels, height, width in self.layout.images:
            end = start + channels * height * width
            frame = self.images[step, :, start:end].reshape(-1, channels, height, width)
            found[name] = np.ascontiguousarray(np.moveaxis(frame, 1, -1) if channels == 3 else frame[:, 0])
            start = end
        return found

    def of_worlds(self, worlds: int, since: int = 0) -> Rows:
        """Those of the first ``worlds`` worlds, with steps numbered from step ``since``."""
        values, marks, images = (each[:, :worlds] for each in (self.values, self.marks, self.images))
        return Rows(replace(self.layout, worlds=worlds), self.first - since, values, marks, images, self.lost)


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
        ValueError: It is not such a file, or one of another layout.
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
