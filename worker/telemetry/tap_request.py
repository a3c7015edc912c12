"""A reader's request for the tap of a training on this machine, for a live recording or view; and the answer to it.

The training's side is :mod:`worker.telemetry.live_tap`.
"""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

from shared_store.volume.files import DamagedFile, read_json, write_json
from shared_store.volume.layout import Run
from worker.settings.errors import UserError
from worker.telemetry.progress import Activity
from worker.telemetry.rows import Layout
from worker.telemetry.segment import Segment

PATIENCE = 180.0
"""Seconds in which a training answers: it does between two iterations."""


def request_of(run: Run) -> Path:
    """Path of a reader's request."""
    return run.telemetry / "request.json"


def answer_of(run: Run) -> Path:
    """Path of the training's answer."""
    return run.telemetry / "tap.json"


def is_alive(host: object, process: object) -> bool:
    """Whether a process of this machine runs; False for one of another machine, which can't be seen from here."""
    if host != socket.gethostname() or not isinstance(process, int) or process <= 0:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass  # another user's
    return True


class Asking:
    """A request for the tap of a run's training. A training has one reader at a time.

    Args:
        run: The run.
        worlds: How many of the main rank's worlds are wanted.
        instead: What works where the training can't be read, for the lines of errors: an instruction.
        newest: Whether the newest control step is enough; the training then brings no other one to the host.
    """

    def __init__(self, run: Run, worlds: int, instead: str, newest: bool = False) -> None:
        self.worlds, self._run, self._instead, self._newest = worlds, run, instead, newest
        self._writer = 0
        """The process that answered."""
        self.note = ""
        """The training's message about what it leaves out."""

    def ask(self) -> None:
        """Put the request; an answer of an earlier one is forgotten. Raises UserError where another process reads."""
        try:
            earlier = read_json(request_of(self._run)) or {}
            if earlier.get("process") != os.getpid() and is_alive(earlier.get("host"), earlier.get("process")):
                raise UserError(
                    f"run {self._run.name} is being recorded or viewed already, by process {earlier['process']}; a training has one "
                    "reader: wait for its end"
                )
            answer_of(self._run).unlink(missing_ok=True)
            request = {"host": socket.gethostname(), "process": os.getpid(), "worlds": self.worlds}
            write_json(request_of(self._run), {**request, "newest": self._newest}, 0o600)
        except (OSError, DamagedFile) as error:
            raise self._unreadable(error) from error

    def answer(self) -> Segment | None:
        """The rows, once the training has answered. Raises UserError where it can't be read; one line says why."""
        try:
            told = read_json(answer_of(self._run))
            if told is None:
                return None
            if "problem" in told:
                answer_of(self._run).unlink(missing_ok=True)
                raise UserError(f"run {self._run.name}: {told['problem']}; go there, or {self._instead}")
            layout = Layout.from_json(told["layout"])
            segment = Segment.open(Path(told["path"]), layout)
            segment.path.unlink(missing_ok=True)  # it lives as long as both map it, and no crash leaves it behind
            self._writer = int(told.get("process", 0))
            self.note = str(told.get("note") or "")
            self.worlds = min(self.worlds, layout.worlds)
            return segment
        except (OSError, DamagedFile, ValueError, KeyError, TypeError) as error:
            raise self._unreadable(error) from error

    def attach(self, patience: float, stop: list[int], activity: Activity) -> Segment:
        """Ask, and wait for the answer; ``stop`` is filled where the user does not want to wait any more. Raises UserError."""
        self.ask()
        activity.say(f"waiting for the training of run {self._run.name} to answer …")
        try:
            until = time.monotonic() + patience
            while (segment := self.answer()) is None:
                if time.monotonic() > until:
                    raise UserError(
                        f"run {self._run.name}: its training did not answer within {patience:.0f} s: it does not run on this "
                        f"machine, or not any more; {self._instead}"
                    )
                if stop:
                    raise UserError(f"run {self._run.name}: interrupted before its training answered; nothing was read")
                time.sleep(0.05)
            return segment
        except UserError:
            self.withdraw()
            raise

    @property
    def is_answered_by_nobody(self) -> bool:
        """Whether the process that answered is gone."""
        return bool(self._writer) and not is_alive(socket.gethostname(), self._writer)

    def withdraw(self) -> None:
        """Withdraw the request; the training sees that it has no reader any more."""
        request_of(self._run).unlink(missing_ok=True)

    def _unreadable(self, error: Exception) -> UserError:
        return UserError(f"run {self._run.name}: its tap can't be read ({error})")
