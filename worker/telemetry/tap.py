"""The tap: a ring on the device that holds the last control steps of a few worlds, filled inside the graph of a step; and its readers.

Filling it is one launch that copies numbers and one that counts; nothing waits for the host, and nothing that the simulation reads is
written. Body poses are not among the numbers: they follow from the joint coordinates, and whoever reads works them out
(:class:`worker.telemetry.stage.Stage`), since kinematics in every step would cost a training more than all the rest.

A reader of a training puts ``telemetry/request.json`` into the run's directory and finds the response in ``telemetry/tap.json``; the rows
go through the machine's memory. Until the first request nothing is tapped; from then on the tap fills its ring to the end of the
training, and a thread works while the reader lives.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Run
from worker.learning.hooks import Hook
from worker.learning.reporter import Gate
from worker.simulation.capture import on_torch_stream
from worker.simulation.episodes import WATCHED, EpisodeArrays
from worker.simulation.worlds import WorldArrays
from worker.telemetry.rows import MARKS, Layout, Rows, Segment
from worker.telemetry.tap_request import is_alive, request_of, response_of

if TYPE_CHECKING:
    from worker.learning.loop import Loop
    from worker.tasks.run.task import Task


wp.set_module_options({"enable_backward": False})

ROWS = 1024
"""Control steps that the ring holds."""
IMAGE_MEMORY = 64 << 20
"""Bytes that the images of a training's ring may take, on the device and, while it has a reader, twice on the host."""
LEAST_ROWS = 32
"""A ring of fewer control steps is overwritten before it is read: then images are left out."""


@wp.kernel
def _fill(
    ends: wp.array[wp.int32],
    states: wp.array2d[wp.float32],
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    ended: wp.array[wp.int32],
    count: wp.array[wp.int64],
    values: wp.array3d[wp.float32],
    marks: wp.array3d[wp.int32],
):
    """One column of one world's row."""
    world, column = wp.tid()
    row = int(count[0] % wp.int64(values.shape[0]))
    value = float(0.0)
    if column < ends[0]:
        value = worlds.joint_q[world, column]
    elif column < ends[1]:
        value = worlds.joint_qd[world, column - ends[0]]
    elif column < ends[2]:
        value = states[world, column - ends[1]]
    elif column < ends[3]:
        value = episodes.actions[world, column - ends[2]]
    elif column < ends[4]:
        value = episodes.terms[world, column - ends[3]]
        episodes.terms[world, column - ends[3]] = 0.0
    else:
        value = episodes.rewards[world]
        marks[row, world, 0] = ended[world]
        marks[row, world, 1] = episodes.ages[world]
        marks[row, world, 2] = wp.where(episodes.dones[world], 1, 0)
        marks[row, world, 3] = wp.where(episodes.time_outs[world], 1, 0)
        marks[row, world, 4] = episodes.causes[world]
    values[row, world, column] = value


@wp.kernel
def _count(dones: wp.array[wp.bool], ended: wp.array[wp.int32], count: wp.array[wp.int64]):
    """A kernel of its own: the row is whole before it counts."""
    for world in range(ended.shape[0]):
        if dones[world]:
            ended[world] = ended[world] + 1
    count[0] = count[0] + wp.int64(1)


@wp.kernel
def _keep_image(
    source: wp.array2d[wp.uint8],
    start: int,
    count: wp.array[wp.int64],
    images: wp.array3d[wp.uint8],
):
    """One byte of one world's present frame, which comes first in its row of ``source``."""
    world, byte = wp.tid()
    images[int(count[0] % wp.int64(images.shape[0])), world, start + byte] = source[world, byte]


class Tap:
    """The ring of a task's first worlds; :meth:`open` makes the task fill it.

    Args:
        task: Whose worlds.
        worlds: How many of them.
        rows: Control steps that the ring holds.
        images: Whether it holds the images that the policy sees, too.

    Raises:
        ValueError: ``worlds`` is not from 1 to that of the task, at most ``WATCHED``.
    """

    def __init__(self, task: Task, worlds: int, rows: int = ROWS, images: bool = True) -> None:
        most = min(WATCHED, task.world_count)
        if not 1 <= worlds <= most:
            raise ValueError(f"worlds is {worlds}; of these worlds 1 to {most} can be watched")
        self.layout = Layout.of(task, worlds, rows, images)
        self.left_out = ""
        """The message about images that are too large for the ring; empty if none is missing."""
        self._task, self.device = task, task.device
        self._sources = [wp.from_torch(task.groups[name].view(task.world_count, -1)) for name, *_ in self.layout.images]
        with on_torch_stream(self.device):
            self._values, self._marks, self._images, self._ended, self._counter = self._arrays = [
                wp.zeros(shape, dtype=kind, device=self.device)
                for shape, kind in (
                    ((rows, worlds, self.layout.width), wp.float32),
                    ((rows, worlds, len(MARKS)), wp.int32),
                    ((rows, worlds, self.layout.image_bytes), wp.uint8),
                    (worlds, wp.int32),
                    (1, wp.int64),
                )
            ]
            self._ends = wp.array(self.layout.ends, dtype=wp.int32, device=self.device)
        tensors: list[torch.Tensor] = [wp.to_torch(each) for each in self._arrays]
        self.values, self.marks, self.images, _, self.count = tensors

    @classmethod
    def within(cls, task: Task, worlds: int) -> Tap:
        """A ring whose images take at most :data:`IMAGE_MEMORY`: with fewer rows, or without images where too few would be left."""
        step = worlds * Layout.of(task, worlds, ROWS).image_bytes
        rows = min(ROWS, IMAGE_MEMORY // step) if step else ROWS
        if rows >= LEAST_ROWS:
            return cls(task, worlds, rows)
        tap = cls(task, worlds, images=False)
        most = IMAGE_MEMORY / LEAST_ROWS
        tap.left_out = (
            f"images are left out: of {worlds} worlds they take {step / 1e6:.1f} MB in each control step, and {most / 1e6:.1f} MB is the "
            "limit; fewer worlds (--worlds) or smaller images fit"
        )
        return tap

    def open(self) -> None:
        """Have the task fill the ring from its next step on. A graph that holds the task's step has to be recorded anew."""
        with on_torch_stream(self.device):
            self._fill()  # loads the kernels, which a capture can't do everywhere
            for array in self._arrays:
                array.zero_()
        self._task.watch(self._fill)

    def close(self) -> None:
        """Have the task fill it no more."""
        self._task.watch(None)

    def _fill(self) -> None:
        episodes: Any = self._task._episodes
        shape = (self.layout.worlds, self.layout.width)
        inputs = [self._ends, episodes.observations, self._task.worlds.arrays, episodes]
        outputs = [self._values, self._marks]
        wp.launch(_fill, dim=shape, inputs=[*inputs, self._ended, self._counter], outputs=outputs, device=self.device)
        start = 0
        for source, (_, *sizes) in zip(self._sources, self.layout.images, strict=True):
            dim = (self.layout.worlds, math.prod(sizes))
            wp.launch(
                _keep_image, dim, inputs=[source, start, self._counter], outputs=[self._images], device=self.device
            )
            start += dim[1]
        wp.launch(_count, dim=1, inputs=[episodes.dones, self._ended, self._counter], device=self.device)


class TapReader:
    """Brings new rows of a tap to the host, on a stream of its own; the device's other work does not wait for it.

    Args:
        tap: What is read, from the next step on.
    """

    def __init__(self, tap: Tap) -> None:
        self._tap = tap
        cuda = tap.device.startswith("cuda")
        self._stream = torch.cuda.Stream(tap.device) if cuda else None
        sources = (tap.values, tap.marks, tap.images)
        self._pairs = [(torch.empty(each.shape, dtype=each.dtype, pin_memory=cuda), each) for each in sources]
        self._counts = torch.zeros(2, dtype=torch.int64, pin_memory=cuda)
        self.next = 0
        """Number of the step that is read next."""

    def take(self, most: int | None = None) -> Rows:
        """The steps since the last call, the newest ``most`` of them, as copies. Those that are left out count as lost, as do those that
        the device overwrote meanwhile."""
        size, started = self._tap.layout.rows, self.next
        self._on_stream(lambda: self._counts[0:1].copy_(self._tap.count, non_blocking=True))
        end = int(self._counts[0])
        first = max(started, end - size + 1, end - (most or size))
        self._on_stream(lambda: self._copy(first, end))
        # of what was copied, the device may have written over the oldest rows, and be at work on one more
        first = min(end, max(first, int(self._counts[1]) - size + 1))
        self.next = end
        places = np.arange(first, end) % size
        values, marks, images = (copy.numpy()[places] for copy, _ in self._pairs)
        return Rows(self._tap.layout, first, values, marks, images, first - started)

    def _copy(self, first: int, end: int) -> None:
        size = self._tap.layout.rows
        while first < end:
            start = first % size
            count = min(end - first, size - start)
            for target, source in self._pairs:
                target[start : start + count].copy_(source[start : start + count], non_blocking=True)
            first += count
        self._counts[1:2].copy_(self._tap.count, non_blocking=True)

    def _on_stream(self, copy: Callable[[], object]) -> None:
        if self._stream is None:
            copy()
            return
        with torch.cuda.stream(self._stream):
            copy()
        self._stream.synchronize()


POLL_SECONDS = 1.0
"""Between two polls for a request, or for the end of the reader."""
DRAIN_SECONDS = 0.02
"""Between two polls of the tap, while it has a reader."""
NEWEST_SECONDS = 0.05
"""The same, for a reader that needs the newest control step alone: a screen."""


class LiveTap(Hook):
    """Serves the tap of the main rank's worlds. :meth:`before_iteration` belongs to the training's thread, everything else to its own."""

    _tap: Tap | None = None
    _pending = 0
    """Worlds that a request needs and the tap does not have yet."""
    _thread: threading.Thread | None = None

    def begin(self, loop: Loop) -> None:
        if loop.gang.is_main:
            self.serve(loop.job.run, loop.task, loop.gate)

    def serve(self, run: Run, task: Task, gate: Gate) -> None:
        """Start the thread.

        Args:
            run: The run.
            task: Its worlds on this rank.
            gate: Which keeps the thread from the interpreter while the training's needs it.
        """
        self._run, self._task, self._gate = run, task, gate
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tap", daemon=True)
        self._thread.start()

    def before_iteration(self) -> bool:
        """Open the tap if a request needs it."""
        if not self._pending:
            return False
        tap = Tap.within(self._task, self._pending)
        tap.open()
        self._tap, self._pending = tap, 0
        return True

    def close(self) -> None:
        """The training has ended, and so does what its reader gets."""
        if self._thread is not None:
            self._closing.set()
            self._thread.join(5.0)

    def _work(self) -> None:
        while not self._closing.wait(POLL_SECONDS):
            # a volume that is not reachable for a while, memory that is short: training goes on, and the reader reports what it misses
            with contextlib.suppress(OSError, ValueError):
                request = read_json(request_of(self._run))
                if request is not None and not response_of(self._run).exists() and self._can_serve(request):
                    self._send_rows(request)

    def _can_serve(self, request: Mapping[str, Any]) -> bool:
        """Whether the reader lives on this machine, and the tap has as many worlds as it needs."""
        here = socket.gethostname()
        if not is_alive(request.get("host"), request.get("process")):
            if request.get("host") != here:
                self._respond(problem=f"the training runs on {here}, and its rows do not leave that machine")
            return False
        worlds = request.get("worlds")
        worlds = min(max(1, worlds if isinstance(worlds, int) else 1), WATCHED, self._task.world_count)
        if self._tap is not None and self._tap.layout.worlds >= worlds:
            return True
        self._pending = worlds
        return False

    def _send_rows(self, request: Mapping[str, Any]) -> None:
        """Until the reader or the training ends."""
        assert self._tap is not None
        reader = TapReader(self._tap)
        reader.next = int(self._tap.count)
        segment = Segment.create(self._tap.layout)
        most, pause = (1, NEWEST_SECONDS) if request.get("newest") is True else (None, DRAIN_SECONDS)
        polled, ended = time.monotonic(), False
        try:
            self._respond(path=str(segment.path), layout=asdict(self._tap.layout), note=self._tap.left_out)
            while not ended:
                ended = self._closing.wait(pause)
                self._gate.wait()
                if len(rows := reader.take(most)):
                    segment.append(rows)
                if time.monotonic() - polled >= POLL_SECONDS:
                    polled = time.monotonic()
                    ended = ended or not is_alive(request["host"], request["process"])
        finally:
            segment.close()
        response_of(self._run).unlink(missing_ok=True)
        newest = read_json(request_of(self._run)) or {}
        if all(newest.get(key) == request[key] for key in ("host", "process")):  # else it is the next reader's
            request_of(self._run).unlink(missing_ok=True)

    def _respond(self, **response: Any) -> None:
        write_json(response_of(self._run), {**response, "process": os.getpid()}, 0o600)
