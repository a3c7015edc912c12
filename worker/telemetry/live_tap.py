"""The live tap of a training: a thread that sees a reader's request, and brings the tap's rows to that reader.

A reader puts ``telemetry/request.json`` into the run's directory and finds the answer in ``telemetry/tap.json``. Both are on one
machine: the rows go through its memory. Until somebody asks nothing is tapped; from then on the tap fills its ring to the end of the
training, and the thread works while the reader lives.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from typing import TYPE_CHECKING, Any

from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Run
from worker.learning.hooks import Hook
from worker.learning.reporter import Gate
from worker.simulation.episodes import WATCHED
from worker.telemetry.segment import Segment
from worker.telemetry.tap import Tap, TapReader
from worker.telemetry.tap_request import answer_of, is_alive, request_of

if TYPE_CHECKING:
    from worker.learning.loop import Loop
    from worker.tasks.run.task import Task

LOOK_SECONDS = 1.0
"""Between two looks for a request."""
DRAIN_SECONDS = 0.02
"""Between two looks at the tap, while it has a reader."""
NEWEST_SECONDS = 0.05
"""The same, for a reader to whom the newest control step is enough: a screen."""


class Attending:
    """Of the main rank. :meth:`attend` belongs to the training's thread, everything else to its own.

    Args:
        run: The run.
        task: Its worlds on this rank.
        gate: Which keeps this thread from the interpreter while the training's needs it.
    """

    def __init__(self, run: Run, task: Task, gate: Gate) -> None:
        self._run, self._task, self._gate = run, task, gate
        self._tap: Tap | None = None
        self._wanted = 0
        """Worlds that a request asks for and the tap does not have yet."""
        self._segment: Segment | None = None
        self._reader: tuple[object, object] = ("", 0)
        self._newest = False
        """Whether the reader wants the newest control step alone."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tap", daemon=True)
        self._thread.start()

    def attend(self) -> bool:
        """Between two iterations: open the tap if it was asked for; returns whether graphs have to be recorded anew."""
        if not self._wanted:
            return False
        tap = Tap.within(self._task, self._wanted)
        tap.open()
        self._tap, self._wanted = tap, 0
        return True

    def close(self) -> None:
        """The training is over; the reader is told."""
        self._over.set()
        self._thread.join(5.0)

    def _work(self) -> None:
        reading: TapReader | None = None
        waited = 0.0
        while not self._over.wait(pause := self._pause()):
            # a volume that is away for a while, memory that is short: training goes on, and the reader says what it misses
            with contextlib.suppress(OSError, ValueError):
                if self._segment is None:
                    reading = self._answer()
                    continue
                assert reading is not None
                self._gate.wait()
                rows = reading.take(1 if self._newest else None)
                if len(rows):
                    self._segment.append(rows)
                waited += pause
                if waited >= LOOK_SECONDS:
                    waited = 0.0
                    if not is_alive(*self._reader):
                        self._leave()
        with contextlib.suppress(OSError, ValueError):
            if self._segment is not None and reading is not None:
                self._segment.append(reading.take(1 if self._newest else None))
                self._leave()

    def _pause(self) -> float:
        """Seconds until the next look."""
        if self._segment is None:
            return LOOK_SECONDS
        return NEWEST_SECONDS if self._newest else DRAIN_SECONDS

    def _answer(self) -> TapReader | None:
        """Answer a request once the tap has as many worlds as it asks for."""
        request = read_json(request_of(self._run))
        if request is None or answer_of(self._run).exists():
            return None
        if not is_alive(request.get("host"), request.get("process")):
            if request.get("host") != socket.gethostname():
                self._say(
                    problem=f"the training runs on {socket.gethostname()}, and its rows do not leave that machine"
                )
            return None
        asked = request.get("worlds")
        worlds = min(max(1, asked if isinstance(asked, int) else 1), WATCHED, self._task.world_count)
        if self._tap is None or self._tap.layout.worlds < worlds:
            self._wanted = worlds
            return None
        reading = TapReader(self._tap)
        reading.next = int(self._tap.count)
        segment = Segment.create(self._tap.layout)
        self._segment, self._reader = segment, (request["host"], request["process"])
        self._newest = request.get("newest") is True
        self._say(path=str(segment.path), layout=self._tap.layout.to_json(), note=self._tap.left_out)
        return reading

    def _say(self, **answer: Any) -> None:
        write_json(answer_of(self._run), {**answer, "process": os.getpid()}, 0o600)

    def _leave(self) -> None:
        if self._segment is not None:
            self._segment.close()
        self._segment = None
        answer_of(self._run).unlink(missing_ok=True)
        request = read_json(request_of(self._run)) or {}
        if (request.get("host"), request.get("process")) == self._reader:  # else it is the next reader's
            request_of(self._run).unlink(missing_ok=True)


class LiveTap(Hook):
    """Has a training answer requests for its tap."""

    def __init__(self) -> None:
        self._attending: Attending | None = None

    def begin(self, loop: Loop) -> None:
        if loop.gang.is_main:
            self._attending = Attending(loop.job.run, loop.task, loop.gate)

    def before_iteration(self) -> bool:
        """Open the tap where it was asked for."""
        return self._attending is not None and self._attending.attend()

    def close(self) -> None:
        if self._attending is not None:
            self._attending.close()
