"""A reader's request for the tap of a training on this machine, for a live recording or view; and the response to it.

The training's side is :mod:`worker.telemetry.tap`.
"""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import counted
from shared_store.volume.files import DamagedFile, read_json, write_json
from shared_store.volume.layout import Run
from worker.settings.errors import UserError
from worker.telemetry.progress import Activity, loading
from worker.telemetry.rows import Layout, Segment

if TYPE_CHECKING:
    from worker.telemetry.stage import Stage

PATIENCE = 180.0
"""Seconds in which a training responds: it does between two iterations."""


def request_of(run: Run) -> Path:
    """Path of a reader's request."""
    return run.telemetry / "request.json"


def response_of(run: Run) -> Path:
    """Path of the training's response."""
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


class TapRequest:
    """A request for the tap of a run's training. A training has one reader at a time.

    Args:
        run: The run.
        worlds: How many of the main rank's worlds are needed; then, how many there are.
        instead: What works where the training can't be read, for the lines of errors: an instruction.
        stop: Filled when the user does not want to wait any more.
        activity: Which shows what takes long.
        newest: Whether the newest control step is enough; the training then brings no other one to the host.
    """

    def __init__(
        self, run: Run, worlds: int, instead: str, stop: list[int], activity: Activity, newest: bool = False
    ) -> None:
        self.worlds, self._run, self._instead, self._newest = worlds, run, instead, newest
        self._stop, self._activity = stop, activity
        self._writer = 0
        """The process that responded."""
        self._note = ""
        """The training's message about what it leaves out."""

    def open(self, patience: float) -> tuple[Segment, Stage, dict[str, Any]]:
        """The rows, the stage of the training's worlds and its section ``train``, after notes for the user. Raises UserError."""
        needed, segment = self.worlds, self.attach(patience)
        try:
            self._activity.say(loading(self._run, self.worlds))
            from worker.telemetry.stage import stage_of

            stage, train = stage_of(self._run, self.worlds)
        except BaseException:
            self.withdraw()
            raise
        few = f"the training has {counted(self.worlds, 'world')} on its main rank" if self.worlds < needed else ""
        for note in filter(None, (few, self._note)):
            print(f"note: {note}", flush=True)
        return segment, stage, train

    def attach(self, patience: float) -> Segment:
        """Send the request, and wait for the response. Raises UserError, also where the user interrupts it."""
        self.send()
        self._activity.say(f"waiting for the training of run {self._run.name} to answer …")
        try:
            until = time.monotonic() + patience
            while (segment := self.response()) is None:
                if time.monotonic() > until:
                    raise UserError(
                        f"run {self._run.name}: its training did not answer within {patience:.0f} s: it does not run on this "
                        f"machine, or not any more; {self._instead}"
                    )
                if self._stop:
                    raise UserError(f"run {self._run.name}: interrupted before its training answered; nothing was read")
                time.sleep(0.05)
            return segment
        except UserError:
            self.withdraw()
            raise

    def send(self) -> None:
        """Put the request; the response to an earlier one is forgotten. Raises UserError where another process reads."""
        try:
            earlier = read_json(request_of(self._run)) or {}
            if earlier.get("process") != os.getpid() and is_alive(earlier.get("host"), earlier.get("process")):
                raise UserError(
                    f"run {self._run.name} is being recorded or viewed already, by process {earlier['process']}; a training has one "
                    "reader: wait for its end"
                )
            response_of(self._run).unlink(missing_ok=True)
            request = {"host": socket.gethostname(), "process": os.getpid(), "worlds": self.worlds}
            write_json(request_of(self._run), {**request, "newest": self._newest}, 0o600)
        except (OSError, DamagedFile) as error:
            raise self._unreadable(error) from error

    def response(self) -> Segment | None:
        """The rows, once the training has responded. Raises UserError where it can't be read; one line says why."""
        try:
            response = read_json(response_of(self._run))
            if response is None:
                return None
            if "problem" in response:
                response_of(self._run).unlink(missing_ok=True)
                raise UserError(f"run {self._run.name}: {response['problem']}; go there, or {self._instead}")
            layout = Layout.from_json(response["layout"])
            segment = Segment.open(Path(response["path"]), layout)
            segment.path.unlink(missing_ok=True)  # it lives as long as both map it, and no crash leaves it behind
            self._writer = int(response.get("process", 0))
            self._note = str(response.get("note") or "")
            self.worlds = min(self.worlds, layout.worlds)
            return segment
        except (OSError, DamagedFile, ValueError, KeyError, TypeError) as error:
            raise self._unreadable(error) from error

    @property
    def is_orphaned(self) -> bool:
        """Whether the process that responded has ended."""
        return bool(self._writer) and not is_alive(socket.gethostname(), self._writer)

    def withdraw(self) -> None:
        """Withdraw the request; the training sees that it has no reader any more."""
        request_of(self._run).unlink(missing_ok=True)

    def _unreadable(self, error: Exception) -> UserError:
        return UserError(f"run {self._run.name}: its tap can't be read ({error})")
