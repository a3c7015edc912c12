"""The live tap of a training: a thread that serves the tap's rows to a reader on the same machine.

A reader puts ``telemetry/request.json`` into the run's directory and finds the response in ``telemetry/tap.json``; the rows go through
the machine's memory. Until the first request nothing is tapped; from then on the tap fills its ring to the end of the training, and the
thread works while the reader lives.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Run
from worker.learning.hooks import Hook
from worker.learning.reporter import Gate
from worker.simulation.episodes import WATCHED
from worker.telemetry.segment import Segment
from worker.telemetry.tap import Tap, TapReader
from worker.telemetry.tap_request import is_alive, request_of, response_of

if TYPE_CHECKING:
    from worker.learning.loop import Loop
    from worker.tasks.run.task import Task

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
        self._respond(path=str(segment.path), layout=asdict(self._tap.layout), note=self._tap.left_out)
        most, pause = (1, NEWEST_SECONDS) if request.get("newest") is True else (None, DRAIN_SECONDS)
        polled, ended = time.monotonic(), False
        while not ended:
            ended = self._closing.wait(pause)
            self._gate.wait()
            if len(rows := reader.take(most)):
                segment.append(rows)
            if time.monotonic() - polled >= POLL_SECONDS:
                polled = time.monotonic()
                ended = ended or not is_alive(request["host"], request["process"])
        segment.close()
        response_of(self._run).unlink(missing_ok=True)
        newest = read_json(request_of(self._run)) or {}
        if (newest.get("host"), newest.get("process")) == (
            request["host"],
            request["process"],
        ):  # else it is the next reader's
            request_of(self._run).unlink(missing_ok=True)

    def _respond(self, **response: Any) -> None:
        write_json(response_of(self._run), {**response, "process": os.getpid()}, 0o600)
