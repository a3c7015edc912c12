"""The reporter and the fence of a training: threads that read and write the volume, so that the training thread waits for no disk or network.

If the volume is unreachable for an hour, the run loses only its newest metrics.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from shared_store.contract.error_text import counted
from shared_store.contract.phases import Phase
from shared_store.volume.epoch import check_epoch
from shared_store.volume.layout import Run

_EVERY = 1.0
"""Seconds between two reads of the epoch."""
_LATE = 2.0
"""Age of the last read of the epoch [s] from which a record waits for the next one."""
_PATIENT = 2.0
"""Longest wait of a record for that read [s]: a hanging volume never answers."""
_MOST = 10_000
"""Calls that wait while the volume does not take them; later ones are dropped."""
_HELD = 0.02
"""Longest wait of a thread at the :class:`Gate` [s]."""
_PRINTED_EVERY = 10.0
"""Time between two lines about compiled kernels [s]."""
_FAREWELL = 30.0
"""Longest wait at the end of a training for the volume to take the last records [s]."""


class Fence:
    """Checks once a second, on its own thread, whether a newer attempt owns the run."""

    def __init__(self, run: Run, epoch: int) -> None:
        self._run, self._epoch = run, epoch
        self._problem: Exception | None = None
        self._read_at = time.monotonic()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="fence", daemon=True).start()

    def check(self) -> None:
        """Does not wait. Raises StaleEpoch if a newer attempt owned the run at the last read, or the error that ended the reading."""
        if self._problem is not None:
            raise self._problem

    def guard(self, write: Callable[..., object], *arguments: Any) -> None:
        """Call ``write`` on the caller's thread, unless a newer attempt owns the run. If the last read of the epoch is old, wait for a new one.

        A stopped process that continues would otherwise write before its next read.
        """
        patience = time.monotonic() + _PATIENT
        while (
            self._problem is None and not self._closed.is_set() and self._read_at + _LATE < time.monotonic() < patience
        ):
            time.sleep(0.01)
        if self._problem is None:
            write(*arguments)

    def close(self) -> None:
        """Stop reading."""
        self._closed.set()

    def _watch(self) -> None:
        while not self._closed.is_set():
            try:
                # the volume is unreachable: try again at the next read
                with contextlib.suppress(OSError, ValueError):
                    check_epoch(self._run, self._epoch)
            except Exception as error:  # StaleEpoch; a defect must not end the fence unseen
                self._problem = error
                return
            self._read_at = time.monotonic()
            self._closed.wait(_EVERY)


class Gate:
    """Keeps other threads off the interpreter while the training thread launches a device's work."""

    def __init__(self) -> None:
        self._open = threading.Event()
        self._open.set()

    def shut(self) -> None:
        """The device has nothing to do."""
        self._open.clear()

    def open(self) -> None:
        """The device is at work."""
        self._open.set()

    def wait(self) -> None:
        """Wait until it is open, at most :data:`_HELD` seconds."""
        self._open.wait(_HELD)


class Reporter:
    """Runs print and write calls in order on its own thread, so that training never waits for them."""

    def __init__(self, gate: Gate | None = None) -> None:
        self._gate = gate or Gate()
        self._calls: queue.Queue[tuple[Callable[..., object], tuple[Any, ...]]] = queue.Queue(_MOST)
        self._dropped = 0
        self._failed = 0
        threading.Thread(target=self._run, name="reporter", daemon=True).start()

    def do(self, function: Callable[..., object], *arguments: Any) -> None:
        """Queue a call of ``function``; does not wait. A call that raises is lost; the first such call is logged as a warning."""
        try:
            self._calls.put_nowait((function, arguments))
        except queue.Full:  # no report is possible: the thread that would print it hangs
            self._dropped += 1

    def close(self) -> None:
        """Wait for the remaining calls, at most :data:`_FAREWELL` seconds, and print how many were lost."""
        done = threading.Event()
        self.do(done.set)
        if not done.wait(_FAREWELL) or self._dropped:
            print(f"warning: the volume did not take the last metrics ({self._dropped} were dropped)", flush=True)
        if self._failed:
            print(
                f"warning: {counted(self._failed, 'report')} failed and {'was' if self._failed == 1 else 'were'} lost",
                flush=True,
            )

    def _run(self) -> None:
        while True:
            function, arguments = self._calls.get()
            self._gate.wait()
            try:
                function(*arguments)
            except Exception as error:  # the thread must live: without it every later record would be lost
                self._failed += 1
                if self._failed == 1:
                    _warn(error)


def _warn(error: Exception) -> None:
    with contextlib.suppress(OSError, ValueError):  # standard output may be what failed
        print(
            f"warning: a report failed ({type(error).__name__}: {error}); training goes on without it\n"
            + "".join(traceback.format_exception(error)),
            end="",
            flush=True,
        )


class Beacon:
    """Messages of a rank to its supervisor, one JSON line each on an inherited pipe: ``phase``
    (:class:`shared_store.contract.phases.Phase`), ``phase_count`` (how far it is: ``37/120``), ``iteration`` and
    ``steps_per_second``, ``message`` (of a save), ``done``.

    A message that finds the pipe full is dropped: the supervisor needs the newest, and the loop must not wait for it.
    Without a supervisor (torchrun, a debugger) nothing is sent.
    """

    def __init__(self, env: Mapping[str, str] | None = None) -> None:
        number = (os.environ if env is None else env).get("MUSTER_PROGRESS_FD", "")
        self._descriptor = int(number) if number.isdecimal() else None

    def send(self, **message: Any) -> None:
        """Send one message of JSON values; does not wait."""
        if self._descriptor is None:
            return
        try:
            os.write(self._descriptor, json.dumps(message).encode() + b"\n")
        except BlockingIOError:
            pass
        except OSError:
            self._descriptor = None  # the supervisor no longer listens

    def enter(self, phase: Phase, done: int | None = None, total: int | None = None) -> None:
        """Report the phase, and how much of it is done where it counts."""
        self.send(phase=phase, phase_count=None if done is None else f"{done}/{total}")


class CompilerProgress:
    """Reports how many kernels are compiled: to the supervisor each time, in the output now and then.

    Args:
        beacon: Where the phase is reported; None: nowhere.
        is_printed: Whether lines are printed.
    """

    def __init__(self, beacon: Beacon | None, *, is_printed: bool) -> None:
        self._beacon, self._is_printed = beacon, is_printed
        self._printed = -_PRINTED_EVERY

    def __call__(self, done: int, total: int) -> None:
        if self._beacon is not None:
            self._beacon.enter(Phase.COMPILING, done, total)
        if self._is_printed and (done == total or time.monotonic() - self._printed >= _PRINTED_EVERY):
            print(f"{Phase.COMPILING} {done}/{total}", flush=True)
            self._printed = time.monotonic()
