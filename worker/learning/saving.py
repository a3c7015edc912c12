"""Asynchronous saving: when a checkpoint is due, and how it is written while the training loop stops only for a copy to host memory."""

from __future__ import annotations

import json
import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, BinaryIO, NamedTuple

import torch

from shared_store.process.tether import start_tied
from shared_store.volume.epoch import StaleEpoch
from shared_store.volume.layout import Run
from worker.learning.host_copies import HostCopies
from worker.learning.reporter import Gate

_BUFFERS = 2
"""One save is written while the next one is copied; a third waits."""
PATIENCE = 2.0
"""Time after the order of the oldest save for which a third one waits [s]; after it, the volume counts as hanging, and training goes on."""
RECORDS_SECONDS = 10.0
"""Longest wait of a commit for the earlier metrics records [s]: a checkpoint is worth more than records that are never written."""


OVERHEAD = 0.01
"""Share of the time that ``every: auto`` spends on saving."""
_FIRST = 5
"""Iterations to the first save, and the minimum between two saves, of ``every: auto``."""
_LONGEST = 1000


class Cadence:
    """When the next checkpoint is due: every so many iterations, or (``auto``) as often as :data:`OVERHEAD` allows (after CheckFreq, FAST'21)."""

    def __init__(self, every: int | str) -> None:
        self.auto = every == "auto"
        self.every = _FIRST if self.auto else int(every)
        self._last = 0

    def expects(self, iteration: int) -> bool:
        """Whether a save after ``iteration`` is likely, before its signals are known."""
        return iteration - self._last >= self.every if self.auto else iteration % self.every == 0

    def due(self, iteration: int, signals: Mapping[str, float]) -> bool:
        """Whether to save after ``iteration``. All ranks decide alike, since ``signals`` are sums over all of them."""
        if self.auto and signals["stall"] > 0 and signals["iteration_seconds"] > 0:
            needed = math.ceil(signals["stall"] / (OVERHEAD * signals["iteration_seconds"]))
            # not at once: if the loop only sometimes waits for the volume, the next save alone does not show it
            self.every = min(max(needed, self.every // 2, _FIRST), _LONGEST)
        if not self.expects(iteration):
            return False
        self._last = iteration
        return True


class _Save(NamedTuple):
    """A save in progress."""

    iteration: int
    since: float
    """Time of its order (``time.perf_counter``)."""
    ordered: Future[None]
    """Done once the writer has its order."""


class Saver:
    """Passes snapshots in order to the writer process of this rank (:mod:`worker.checkpoint_writer`), and reports their results.

    The loop waits while the state is copied. A thread serialises the copies, and the process writes the file.
    """

    def __init__(self, run: Run, epoch: int, rank: int, ranks: int, keep: int | None, gate: Gate | None = None) -> None:
        self.run, self.epoch, self.rank, self.ranks, self.keep = run, epoch, rank, ranks, keep
        self.committed: str | None = None
        """Name of the newest checkpoint that is durable (main rank)."""
        self.failures = 0
        """Failed saves of this rank that the gang does not know of yet."""
        self.stall = 0.0
        """Time for which the last save stopped the loop [s]."""
        self._copying = 0.0
        self._gate = gate or Gate()
        self._copies = HostCopies()
        self._memory = [os.fdopen(os.memfd_create("muster-snapshot"), "wb", 1 << 20) for _ in range(_BUFFERS)]
        self._records = os.fdopen(os.memfd_create("muster-records"), "wb")
        self._orders = 0
        self._pending: list[_Save] = []
        self._thread = ThreadPoolExecutor(1, "snapshots")
        self._process: subprocess.Popen[bytes] | None = None
        self._answers = b""
        self._lines: list[str] = []
        """Unreported lines about finished saves."""

    def start(self) -> None:
        """Start the writer in advance, so that the first save does not wait for it."""
        if self._process is None:
            self._start()

    @property
    def is_busy(self) -> bool:
        """Whether the volume hangs: no save can be ordered, and an earlier one has been in progress for :data:`PATIENCE`."""
        return len(self._pending) >= _BUFFERS and self._patience() == 0.0

    def note_records(self, iteration: int) -> None:
        """Inform the writer that the metrics records up to ``iteration`` are written. Any thread may call it."""
        os.pwrite(self._records.fileno(), iteration.to_bytes(8, "little"), 0)

    def copy(self, state: Any) -> Any:
        """Copies of all tensors in ``state``, for a save. A device may still be computing them; this does not wait for it.

        They are valid until the next call.
        """
        started = time.perf_counter()
        if self._pending:
            self._pending[-1].ordered.exception()  # until it has read the copies before these
        copied = self._copies.take(state)
        self._copying = time.perf_counter() - started
        return copied

    def save(
        self,
        iteration: int,
        files: Mapping[str, Any],
        facts: Mapping[str, Any] | None,
        *,
        after_records: bool = False,
        wait: bool = True,
    ) -> None:
        """Order a save of copies of the state; returns before any write to the volume.

        Args:
            iteration: Number of finished iterations.
            files: Name and content of each file: dictionaries of copies from :meth:`copy` and of plain values, which must not change.
            facts: Further entries of the manifest; the main rank passes them, and commits.
            after_records: Commit only after :meth:`note_records` of this iteration, or after :data:`RECORDS_SECONDS`.
            wait: Wait for earlier saves, however long; otherwise the save fails if they take longer than :data:`PATIENCE`.

        Raises:
            StaleEpoch: A newer attempt owns the run.
        """
        started = time.perf_counter() - self._copying
        self._copying = 0.0
        while len(self._pending) >= _BUFFERS:
            if not self._take_answer(None if wait else self._patience()):
                self._fail(iteration, "earlier saves are still being written")
                self.stall = time.perf_counter() - started
                return
        memory = self._memory[self._orders % _BUFFERS]
        self._orders += 1
        order = {
            "run": str(self.run.path),
            "iteration": iteration,
            "epoch": self.epoch,
            "rank": self.rank,
            "ranks": self.ranks,
            "memory": memory.fileno(),
            "facts": facts,
            "keep": self.keep,
            "records": {"memory": self._records.fileno(), "seconds": RECORDS_SECONDS} if after_records else None,
        }
        ordered = self._thread.submit(self._order, self._writer(), memory, order, files)
        self._pending.append(_Save(iteration, started, ordered))
        self.stall = time.perf_counter() - started

    def _order(
        self, writer: subprocess.Popen[bytes], memory: BinaryIO, order: Mapping[str, Any], files: Mapping[str, Any]
    ) -> None:
        """On the thread: write the files' content into the memory that the writer reads, and send it the order."""
        self._gate.wait()
        self._copies.wait()
        layout = []
        memory.seek(0)  # an earlier save's bytes beyond the end stay, unread
        for name, snapshot in files.items():
            begin = memory.tell()
            torch.save(snapshot, memory)
            layout.append((name, begin, memory.tell() - begin))
        memory.flush()
        _send(writer, {**order, "files": layout})

    def poll(self) -> list[str]:
        """Results of earlier saves, a line for each that ended; does not wait. Raises StaleEpoch."""
        while self._pending and self._take_answer(0.0):
            pass
        return self._new_lines()

    def wait(self) -> list[str]:
        """As :meth:`poll`, but waits for all saves in progress. Raises StaleEpoch."""
        while self._pending:
            self._take_answer(None)
        return self._new_lines()

    def abandon(self) -> None:
        """Another rank's part of a save failed: the main rank's writer must not wait for it."""
        for each in self._pending:
            if self._process:
                _send(self._process, {"abandon": each.iteration})

    def close(self) -> None:
        """End the writer, after all saves in progress. Raises StaleEpoch."""
        self.wait()
        self._thread.shutdown()
        if self._process and self._process.stdin:
            self._process.stdin.close()
            self._process.wait()
            self._process = None
        for file in (*self._memory, self._records):
            file.close()

    def _patience(self) -> float:
        """Remaining time for which a save waits for the oldest one [s]."""
        return max(0.0, self._pending[0].since + PATIENCE - time.perf_counter())

    def _new_lines(self) -> list[str]:
        lines, self._lines = self._lines, []
        return lines

    def _writer(self) -> subprocess.Popen[bytes]:
        """The writer's process, a new one if it died: saves that it had answered count, the others are lost."""
        if self._process is not None and self._process.poll() is not None:
            while self._process is not None:
                self._take_answer(None)
        if self._process is None:
            self._start()
        assert self._process is not None
        return self._process

    def _start(self) -> None:
        """Start the writer: it dies with this process, and has a session of its own, out of reach of the group's SIGTERM."""
        self._answers = b""
        self._process = start_tied(
            [sys.executable, "-P", "-m", "worker.checkpoint_writer"],
            ignoring=[signal.SIGTERM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[file.fileno() for file in (*self._memory, self._records)],
            start_new_session=True,
        )

    def _take_answer(self, seconds: float | None) -> bool:
        """Process the next answer, after a wait of up to ``seconds`` (None: forever); False without an answer. Raises StaleEpoch."""
        if self._pending:
            try:
                self._pending[0].ordered.result(seconds)
            except TimeoutError:
                return False
        assert self._process is not None and self._process.stdout is not None
        while b"\n" not in self._answers:
            if not select.select([self._process.stdout], [], [], seconds)[0]:
                return False
            chunk = os.read(self._process.stdout.fileno(), 65536)
            if not chunk:
                self._lost()
                return True
            self._answers += chunk
        line, _, self._answers = self._answers.partition(b"\n")
        iteration = self._pending.pop(0).iteration
        answer = json.loads(line)
        if "stale" in answer:
            raise StaleEpoch(answer["stale"])
        if "failed" in answer:
            self._fail(iteration, answer["failed"])
        elif "committed" in answer:
            self.committed = answer["committed"]
            self._lines.append(f"checkpoint {self.committed}")
            if not answer["recorded"]:
                self._lines.append(
                    f"warning: checkpoint {self.committed} was committed before the metrics up to it were written; "
                    "a run that goes on from it may lack some"
                )
        return True

    def _fail(self, iteration: int, why: str) -> None:
        self.failures += 1
        self._lines.append(f"warning: iteration {iteration} could not be saved ({why}); training goes on")

    def _lost(self) -> None:
        """The writer died: all its saves are lost, and the next save starts another."""
        assert self._process is not None
        code = self._process.wait()
        self._process = None
        lost, self._pending = self._pending, []
        for each in lost:
            self._fail(each.iteration, f"its writer died with code {code}")


def _send(writer: subprocess.Popen[bytes], order: Mapping[str, Any]) -> None:
    assert writer.stdin
    try:
        writer.stdin.write(json.dumps(order).encode() + b"\n")
        writer.stdin.flush()
    except BrokenPipeError:
        pass  # it has just died: the missing answer shows it
