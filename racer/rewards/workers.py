"""Workers that call a reward function: a pool of processes for all cars of a step, for functions that are not compiled.

Each car has a copy of the file's own, as on AWS, where a process drives one car: what the function remembers is that car's.

The arrays are in shared memory; a step costs one message to each process and one back.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import mmap
import os
import select
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from racer.rewards.confinement import MEMORY
from racer.rewards.guard import environment
from racer.rewards.interpreter import ANEW
from racer.rewards.parameters import MOST_OBJECTS, NUMBERS, OBJECT_NUMBERS, Point
from racer.rewards.problems import Failure, RewardFailed, alike, plain

SECONDS = 2.0
"""For one call [s]."""
_START, _COPY = 120.0, 5.0
"""For a process to start and import what the function imports, and for the copy of a car [s]."""
_MOST_OUTPUT = 1 << 20
"""Bytes of an answer."""
_LONGEST = 300
"""Characters of a message."""
_Number = Annotated[int, Field(ge=0, lt=1 << 31)]


@dataclass(frozen=True)
class _End:
    """The last answer of a process: why it goes on no more; ``car`` -1: no car's call is the cause."""

    message: str
    line: _Number
    car: Annotated[int, Field(ge=-1, lt=1 << 31)]


_ANSWER: TypeAdapter[_End | list[tuple[str, int, int, int]]] = TypeAdapter(
    _End | list[tuple[str, _Number, _Number, _Number]]
)
"""What a process may answer: the function may have it in its hands."""


class Workers:
    """Processes that call a reward function.

    Args:
        source: Text of its file.
        file: Its name, in messages.
        tracks: Waypoints of each track [m].
        worlds: How many cars there are.
        processes: How many processes share them; by default one for each processor that may be used, at most one for each 16 cars.
        seconds: For one call [s].
        memory: Bytes of address space of each process.

    The thread that makes the pool has to live as long as it: the kernel ends the processes with that thread.

    Attributes:
        numbers: What the functions read of the cars, shape ``(worlds, NUMBERS)``, float32, to be filled before a call.
        objects: Of their objects, shape ``(worlds, MOST_OBJECTS, OBJECT_NUMBERS)``, float32.
        failures: The calls that gave no reward so far, by their message.
        processes: The processes; none once they are ended.

    Raises:
        RewardFailed: The file can't be loaded.
    """

    def __init__(
        self,
        source: str,
        file: str,
        tracks: Sequence[Sequence[Point]],
        worlds: int,
        processes: int | None = None,
        seconds: float = SECONDS,
        memory: int = MEMORY,
    ) -> None:
        count = processes or min(len(os.sched_getaffinity(0)), -(-worlds // 16))
        self.file, self._seconds, self._share = file, seconds, -(-worlds // count)
        cells = worlds * (NUMBERS + MOST_OBJECTS * OBJECT_NUMBERS + 1)
        self._descriptor = os.memfd_create("rewards", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(self._descriptor, 4 * cells)
        # shorter, it would kill those that have it mapped
        fcntl.fcntl(self._descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
        shared = np.frombuffer(mmap.mmap(self._descriptor, 0), dtype=np.float32)
        self.numbers, rest = np.split(shared, [worlds * NUMBERS])
        self.objects, self._rewards = np.split(rest, [worlds * MOST_OBJECTS * OBJECT_NUMBERS])
        self.numbers = self.numbers.reshape(worlds, NUMBERS)
        self.objects = self.objects.reshape(worlds, MOST_OBJECTS, OBJECT_NUMBERS)
        self.failures: dict[str, Failure] = {}
        self._first: dict[str, str] = {}
        self._called = False
        request = {
            "source": source,
            "file": file,
            "seconds": seconds,
            "memory": memory,
            "root": str(Path(__file__).parents[2]),
            "worlds": worlds,
            "tracks": [np.asarray(track, dtype=np.float32).tolist() for track in tracks],
            "shared": self._descriptor,
        }
        firsts = range(0, worlds, self._share)
        self.processes: list[subprocess.Popen[bytes]] = []
        try:
            for first in firsts:
                self._start({**request, "first": first, "last": min(first + self._share, worlds)})
            self._answers(_START + _COPY * self._share)
        except BaseException:
            self.close()
            raise

    def begin_anew(self) -> None:
        """Forget all that the cars' functions remember, and the failures.

        Raises:
            RewardFailed: The file can't be loaded again. The pool is closed.
        """
        self.failures.clear()
        if self._called:
            self._called = False
            self._request(ANEW, _START + _COPY * self._share)

    def _start(self, request: Mapping[str, Any]) -> None:
        process = subprocess.Popen(
            [sys.executable, "-I", "-B", str(Path(__file__).with_name("interpreter.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment(),
            pass_fds=[self._descriptor],
        )
        self.processes.append(process)
        assert process.stdin is not None
        process.stdin.write(json.dumps(request).encode() + b"\n")
        process.stdin.flush()

    def rewards(self) -> np.ndarray:
        """The rewards of the cars in ``numbers`` and ``objects``, shape ``(worlds,)``, float32.

        A call that raises, or returns anything but a finite number, gives NaN and is counted in ``failures``.

        Raises:
            RewardFailed: A call does not return, floods its output or ends its process. The pool is closed.
        """
        self._called = True
        self._request(b"\n", self._seconds * (self._share + 1) + 5.0)
        return self._rewards.copy()

    def _request(self, line: bytes, patience: float) -> None:
        if not self.processes:
            raise RewardFailed(f"{self.file}: the processes that call the reward function have ended")
        try:
            for process in self.processes:
                assert process.stdin is not None
                with contextlib.suppress(BrokenPipeError):  # its end is reported when its answer is missing
                    process.stdin.write(line)
                    process.stdin.flush()
            self._answers(patience)
        except BaseException:
            self.close()
            raise

    def _answers(self, patience: float) -> None:
        """Wait for a line from each process."""
        until = time.monotonic() + patience
        for number, process in enumerate(self.processes):
            line = self._line(process, number, until)
            try:
                answer = _ANSWER.validate_json(line, strict=True)
            except ValidationError:
                message = "the process of the function answered what it never writes: the function wrote to its pipe"
                raise RewardFailed(f"{self.file}: {self._cars(number)}: {message}") from None
            if isinstance(answer, _End):
                place = f"{self.file}:{answer.line}" if answer.line else self.file
                who = f"car {answer.car}: " if answer.car >= 0 else ""
                raise RewardFailed(f"{place}: {who}{plain(answer.message, _LONGEST)}")
            for error, at, car, count in answer:
                message = plain(error, _LONGEST)
                place = f"{self.file}:{at}" if at else self.file
                first = self._first.setdefault(f"{at}: {alike(message)}", f"{place}: {message}")
                self.failures.setdefault(first, Failure(0, car)).count += count

    def _line(self, process: subprocess.Popen[bytes], number: int, until: float) -> bytes:
        """An answer, whole."""
        assert process.stdout is not None
        cars = self._cars(number)
        answer, poll = b"", select.poll()
        poll.register(process.stdout, select.POLLIN)
        while not answer.endswith(b"\n"):
            if not poll.poll(max(0.0, 1000.0 * (until - time.monotonic()))):
                raise RewardFailed(f"{self.file}: {cars}: the function did not return, and its process takes no signal")
            part = os.read(process.stdout.fileno(), 1 << 16)
            if len(answer) > _MOST_OUTPUT:
                raise RewardFailed(f"{self.file}: {cars}: the function's process answers without end")
            if not part:
                code = process.wait()
                cause = f"signal {-code}" if code < 0 else f"exit code {code}"
                raise RewardFailed(f"{self.file}: {cars}: the process of the function ended ({cause})")
            answer += part
        return answer

    def _cars(self, number: int) -> str:
        """The cars of a process, in messages."""
        first = number * self._share
        return f"cars {first} to {min(first + self._share, len(self._rewards)) - 1}"

    def close(self) -> None:
        """End the processes."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self.processes = []
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
