"""A machine whose time passes at once: every thread is a greenlet, and the seed decides which call takes how long."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from concurrent.futures import Future
from random import Random
from typing import Any, TypeVar

import greenlet

from orchestrator.machine import Machine, Pool

T = TypeVar("T")


class Violation(BaseException):
    """Something does not hold that always must. Not an Exception, which the control plane would take for a fault of an engine."""


class Crash(BaseException):
    """The controller's process is killed at this point."""


class LoopWaits(BaseException):
    """The controller's loop waits for a call."""


class SimulatedMachine(Machine):
    """Clocks, events in the order of their times, and pools whose calls are events."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        self.time = 1000.0
        self.offset = 1_800_000_000.0
        """Wall-clock time less monotonic time [s]."""
        self.process = 0
        """Number of the controller's process: calls of an earlier one have no effect on it."""
        self.latency: Callable[[str], float] = lambda pool: 0.01
        """Seconds that a call of a pool takes."""
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._hub = greenlet.getcurrent()

    def processor_time(self) -> float:
        return 0.0

    def monotonic(self) -> float:
        return self.time

    def wall(self) -> float:
        return self.time + self.offset

    def boot(self) -> str:
        return "boot"

    def thread(self, name: str, body: Callable[[], None]) -> Any:
        self.after(0.0, body)

    def pool(self, name: str, threads: int, waiting: int | None = None) -> Pool:
        return SimulatedPool(self, name, threads)

    def after(self, seconds: float, body: Callable[[], None]) -> None:
        """Carry out ``body`` later."""
        self._count += 1
        heapq.heappush(self._events, (self.time + seconds, self._count, body))

    def step(self) -> None:
        """Let time pass until the next event, and carry it out, on a greenlet of its own: it may sleep."""
        self.time, _, body = heapq.heappop(self._events)
        body()

    def sleep(self, seconds: float) -> None:
        """Let the present call take so long. Raises LoopWaits where the loop itself makes it."""
        current = greenlet.getcurrent()
        if current is self._hub:
            raise LoopWaits
        self.after(seconds, current.switch)
        self._hub.switch()

    def result(self, future: Future[T], seconds: float) -> T:
        deadline = self.time + seconds
        while not future.done() and self.time < deadline and greenlet.getcurrent() is not self._hub:
            self.sleep(0.05)
        return future.result(0)


class SimulatedPool:
    """Calls of one process, each carried out by some moment between its submission and its return."""

    def __init__(self, machine: SimulatedMachine, name: str, threads: int) -> None:
        self._machine, self._name, self._free = machine, name, threads
        self._process = machine.process
        self._waiting: list[Callable[[], None]] = []
        self._began: dict[int, float] = {}
        self._count = 0

    def submit(self, body: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()
        self._count += 1
        number = self._count

        def call() -> None:
            greenlet.greenlet(lambda: self._call(number, body, future)).switch()

        self._waiting.append(call)
        self._start()
        return future

    @property
    def busy_since(self) -> float | None:
        return min(self._began.values(), default=None)

    def close(self, patience: float = 0.0) -> None:
        self._waiting.clear()

    def _start(self) -> None:
        while self._free and self._waiting:
            self._free -= 1
            self._machine.after(0.0, self._waiting.pop(0))

    def _call(self, number: int, body: Callable[[], T], future: Future[T]) -> None:
        machine = self._machine
        self._began[number] = machine.time
        takes = machine.latency(self._name)
        before = takes * machine.rng.random()
        machine.sleep(before)
        if self._process != machine.process and machine.rng.random() < 0.5:
            return  # killed before it had an effect
        result: T | None = None
        error: BaseException | None = None
        try:
            result = body()
        except Violation:
            raise  # to those who look at the world, past those who would collect the result
        except BaseException as raised:
            error = raised
        machine.sleep(takes - before)
        if self._process != machine.process:
            return
        del self._began[number]
        self._free += 1
        self._start()
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)  # type: ignore[arg-type]
