"""Asynchronous saving, seen from the training loop: it stops only while the state is copied to host memory."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch

from shared_store.epoch import StaleEpoch
from shared_store.layout import Run
from shared_store.tied import tied

_BUFFERS = 2
"""One save is written while the next one is copied; a third waits."""
PATIENCE = 2.0
"""For how long after the order of the oldest save a third one waits for it [s]: the volume hangs, and training goes on without."""
RECORDS_SECONDS = 10.0
"""How long a commit waits for the metrics records before it [s]: a checkpoint is worth more than records that are never written."""


class HostCopies:
    """Copies of device tensors in pinned host memory that is kept: the device is waited for one time a save."""

    def __init__(self) -> None:
        self._pinned: dict[str, tuple[tuple[object, ...], torch.Tensor]] = {}
        """Each with the form of what it is a copy of."""
        self._copied = False

    def take(self, value: Any, key: str = "") -> Any:
        """``value`` with every CUDA tensor in it replaced by its copy, which is complete after :meth:`wait`.

        Of a CPU tensor that is part of a larger one the part is copied: ``torch.save`` would write the whole.
        """
        if isinstance(value, torch.Tensor) and value.is_cuda:
            # the strides, too: where dimensions lie in another order, the device makes a copy of its own first
            form = value.dtype, value.shape, value.stride()
            if key not in self._pinned or self._pinned[key][0] != form:
                self._pinned[key] = form, torch.empty_like(value, device="cpu", pin_memory=True)
            self._copied = True
            return self._pinned[key][1].copy_(value.detach(), non_blocking=True)
        if isinstance(value, torch.Tensor):
            return value.detach().clone() if value.nbytes < value.untyped_storage().nbytes() else value
        if isinstance(value, dict):
            return {name: self.take(item, f"{key}/{name}") for name, item in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(self.take(item, f"{key}/{index}") for index, item in enumerate(value))
        return value

    def wait(self) -> None:
        """Until the copies are complete."""
        if self._copied:
            torch.cuda.current_stream().synchronize()


class Saver:
    """Hands snapshots to the writer process of this rank (:mod:`worker.checkpoint_writer`), in order, and tells how they ended."""

    def __init__(self, run: Run, epoch: int, rank: int, ranks: int, keep: int | None) -> None:
        self.run, self.epoch, self.rank, self.ranks, self.keep = run, epoch, rank, ranks, keep
        self.committed: str | None = None
        """Name of the newest checkpoint that is durable (main rank)."""
        self.failures = 0
        """Saves of this rank that failed and that the gang has not been told of."""
        self.stall = 0.0
        """How long the last save stopped the loop [s]."""
        self._copies = HostCopies()
        self._memory = [os.memfd_create(f"muster-snapshot-{index}") for index in range(_BUFFERS)]
        self._records = os.memfd_create("muster-records")
        self._given = 0
        self._pending: list[tuple[int, float]] = []
        """Iteration of each save that is under way, and when it was ordered (``time.perf_counter``)."""
        self._process: subprocess.Popen[bytes] | None = None
        self._answers = b""
        self._lines: list[str] = []
        """What is still to be told of saves that ended."""

    def start(self) -> None:
        """Start the writer before it is needed: it would otherwise be the first save that waits for its start."""
        if self._process is None:
            self._start()

    @property
    def is_busy(self) -> bool:
        """Whether the volume hangs: no save can be ordered, and an earlier one has been under way for :data:`PATIENCE`."""
        return len(self._pending) >= _BUFFERS and self._patience() == 0.0

    def note_records(self, iteration: int) -> None:
        """Let the writer know that the metrics records up to ``iteration`` are written. Any thread may call it."""
        os.pwrite(self._records, iteration.to_bytes(8, "little"), 0)

    def save(
        self,
        iteration: int,
        files: Mapping[str, Callable[[], Any]],
        facts: Mapping[str, Any] | None,
        *,
        after_records: bool = False,
        wait: bool = True,
    ) -> None:
        """Copy the state and order its saving; returns before anything is on the volume.

        Args:
            iteration: Iterations done.
            files: Name of each file and a function that gives its content: dictionaries of tensors and plain values.
            facts: What the manifest says besides; the main rank gives it, and commits.
            after_records: Commit only after :meth:`note_records` of this iteration, or after :data:`RECORDS_SECONDS`.
            wait: For earlier saves, as long as they take; else the save fails where they take longer than :data:`PATIENCE`.

        Raises:
            StaleEpoch: A newer attempt owns the run.
        """
        started = time.perf_counter()
        while len(self._pending) >= _BUFFERS:
            if not self._take_answer(None if wait else self._patience()):
                self._fail(iteration, "earlier saves are still being written")
                self.stall = time.perf_counter() - started
                return
        memory = self._memory[self._given % _BUFFERS]
        self._given += 1
        layout = []
        snapshots = {name: self._copies.take(content(), name) for name, content in files.items()}
        self._copies.wait()
        with open(memory, "wb", buffering=1 << 20, closefd=False) as file:
            file.seek(0)  # what an earlier save left behind the end stays, and is not read
            for name, snapshot in snapshots.items():
                begin = file.tell()
                torch.save(snapshot, file)
                layout.append((name, begin, file.tell() - begin))
        order = {
            "run": str(self.run.path),
            "iteration": iteration,
            "epoch": self.epoch,
            "rank": self.rank,
            "ranks": self.ranks,
        }
        records = {"memory": self._records, "seconds": RECORDS_SECONDS} if after_records else None
        self._send({**order, "files": layout, "memory": memory, "facts": facts, "keep": self.keep, "records": records})
        self._pending.append((iteration, started))
        self.stall = time.perf_counter() - started

    def poll(self) -> list[str]:
        """What has become of earlier saves, a line for each that ended; does not wait. Raises StaleEpoch."""
        while self._pending and self._take_answer(0.0):
            pass
        return self._told()

    def wait(self) -> list[str]:
        """As :meth:`poll`, for all that are under way. Raises StaleEpoch."""
        while self._pending:
            self._take_answer(None)
        return self._told()

    def abandon(self) -> None:
        """Another rank's part of a save failed: the main rank's writer must not wait for it."""
        for iteration, _ in self._pending:
            self._send({"abandon": iteration})

    def close(self) -> None:
        """End the writer; what is under way is waited for. Raises StaleEpoch."""
        self.wait()
        if self._process and self._process.stdin:
            self._process.stdin.close()
            self._process.wait()
            self._process = None

    def _patience(self) -> float:
        """How long a save still waits for the oldest one [s]."""
        return max(0.0, self._pending[0][1] + PATIENCE - time.perf_counter())

    def _told(self) -> list[str]:
        lines, self._lines = self._lines, []
        return lines

    def _send(self, order: Mapping[str, Any]) -> None:
        if self._process is not None and self._process.poll() is not None:
            while self._process is not None:  # it died: what it had answered counts, the rest is lost
                self._take_answer(None)
        if self._process is None:
            self._start()
        assert self._process is not None and self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it has just died: the answer that does not come says so

    def _start(self) -> None:
        """Start the writer: tied to this process's life, and in a session of its own, where the group's SIGTERM does not reach it.

        Slurm sends SIGTERM to every process of a step, whatever its session: the writer ignores it from its first instant.
        """
        self._answers = b""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
        try:
            self._process = subprocess.Popen(
                tied([sys.executable, "-P", "-m", "worker.checkpoint_writer"], ignoring=[signal.SIGTERM]),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=[*self._memory, self._records],
                start_new_session=True,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _take_answer(self, seconds: float | None) -> bool:
        """Note the next answer, waiting for it up to ``seconds`` (None: for ever); False where none came. Raises StaleEpoch."""
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
        iteration, _ = self._pending.pop(0)
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
        """The writer died: all that it had is lost, and the next save starts another."""
        assert self._process is not None
        code = self._process.wait()
        self._process = None
        lost, self._pending = self._pending, []
        for iteration, _ in lost:
            self._fail(iteration, f"its writer died with code {code}")
