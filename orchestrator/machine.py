"""The machine that the controller runs on: its clocks, its threads, and the pools for calls that may hang.

The controller reads time and starts threads here alone, so that a simulation can replace the machine as a whole (:func:`replaced_by`).
"""

from __future__ import annotations

import ctypes
import gc
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Protocol, TypeVar

T = TypeVar("T")

_IDLE = 60.0
"""Seconds after which a thread of a pool ends that has nothing to do."""
_AS_PYTHON = gc.get_threshold()
_ARENA_MAX = -8
"""``M_ARENA_MAX`` of ``mallopt``."""
_GARBAGE = 20_000
"""Objects, some MB, that may be garbage before it is looked for."""


def collect_seldom() -> None:
    """Look for cyclic garbage seldom, and not in what is loaded now: a search through all that holds up requests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_GARBAGE, 5, 3)


def collect_all() -> None:
    """End what :func:`collect_seldom` began, in a process that goes on without a controller."""
    gc.unfreeze()
    gc.set_threshold(*_AS_PYTHON)


def share_arenas() -> None:
    """Limit glibc to two arenas for all threads of this process.

    Each arena keeps the memory that was freed in it, and by default nearly every thread gets its own. A thread that has one keeps
    it, so call this early. Does nothing with another C library.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 2)


class PoolFull(Exception):
    """All threads of a pool are busy, and no more calls may wait; the message says since when."""


class Pool(Protocol):
    """Carries out calls that may hang, on a bounded number of threads."""

    def submit(self, body: Callable[[], T]) -> Future[T]:
        """The result of ``body``, later; never, once the pool is closed. Raises PoolFull."""
        ...

    @property
    def busy_since(self) -> float | None:
        """Since when the oldest of the present calls is being carried out (monotonic [s]); None while there is none."""
        ...

    def close(self, patience: float = 0.0) -> None:
        """Drop the calls that wait, and give those that are being carried out so many seconds."""
        ...


class ThreadPool:
    """Daemon threads, started as they are needed and ended when they idle: one that hangs does not keep the process alive."""

    def __init__(self, name: str, threads: int, waiting: int | None) -> None:
        """``waiting``: how many calls may wait for a thread; None: any number."""
        self._name, self._threads, self._most = name, threads, waiting
        self._lock = threading.Lock()
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._began: dict[threading.Thread, float | None] = {}
        """By thread: when its present call began; None while it waits for one."""
        self._open = 0
        """Calls that were submitted and have not returned."""
        self._closing = False

    def submit(self, body: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()

        def call() -> None:
            if not future.set_running_or_notify_cancel():
                return  # whoever waited for it has left
            try:
                result = body()
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)

        with self._lock:
            if self._most is not None and self._open >= self._threads + self._most:
                raise PoolFull(f"{self._threads} calls of {self._name} are under way, and {self._most} wait")
            self._open += 1
            if self._open > len(self._began) and len(self._began) < self._threads:
                thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._began[thread] = None
                thread.start()
        self._calls.put(call)
        return future

    @property
    def busy_since(self) -> float | None:
        return min((began for began in list(self._began.values()) if began is not None), default=None)

    def close(self, patience: float = 0.0) -> None:
        self._closing = True
        deadline = time.monotonic() + patience
        with self._lock:
            threads = list(self._began)
        for _ in threads:
            self._calls.put(None)
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self) -> None:
        me = threading.current_thread()
        while (call := self._next()) is not None and not self._closing:
            self._began[me] = time.monotonic()
            call()
            del call  # its result does not live on while the thread idles
            self._began[me] = None
            with self._lock:
                self._open -= 1

    def _next(self) -> Callable[[], None] | None:
        """The next call; None for a thread that is to end."""
        while True:
            try:
                return self._calls.get(timeout=_IDLE)
            except Empty:
                with self._lock:
                    if self._open < len(self._began):  # the others can carry out all calls that were submitted
                        del self._began[threading.current_thread()]
                        return None


class Machine:
    """This machine."""

    def monotonic(self) -> float:
        """Seconds of a clock that no one sets."""
        return time.monotonic()

    def wall(self) -> float:
        """Unix time [s]."""
        return time.time()

    def processor_time(self) -> float:
        """Processor time that the present thread has used [s]."""
        return time.thread_time()

    def boot(self) -> str:
        """An identifier of this boot of the machine: it stays while the monotonic clock runs."""
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()

    def sleep(self, seconds: float) -> None:
        """Let the present thread wait."""
        time.sleep(seconds)

    def thread(self, name: str, body: Callable[[], None]) -> threading.Thread:
        """Start ``body`` on a daemon thread."""
        thread = threading.Thread(target=body, name=name, daemon=True)
        thread.start()
        return thread

    def result(self, future: Future[T], seconds: float) -> T:
        """The result of a pool's call. Raises TimeoutError where it is not there in time."""
        return future.result(seconds)

    def pool(self, name: str, threads: int, waiting: int | None = None) -> Pool:
        """A pool of so many threads; ``waiting``: how many calls may wait for one, any number by default."""
        return ThreadPool(name, threads, waiting)


_current = Machine()


@contextmanager
def replaced_by(machine: Machine) -> Iterator[None]:
    """A context in which the controller runs on another machine."""
    global _current
    before, _current = _current, machine
    try:
        yield
    finally:
        _current = before


def monotonic() -> float:
    """Seconds of a clock that no one sets."""
    return _current.monotonic()


def wall() -> float:
    """Unix time [s]."""
    return _current.wall()


def processor_time() -> float:
    """Processor time that the present thread has used [s]."""
    return _current.processor_time()


@dataclass(frozen=True)
class Moment:
    """When something began."""

    monotonic: float
    """Seconds of the clock that no one sets."""
    wall: float
    """Unix time [s]."""

    @property
    def passed(self) -> float:
        """Seconds since then."""
        return monotonic() - self.monotonic

    def __str__(self) -> str:
        return f"{datetime.fromtimestamp(self.wall, UTC):%Y-%m-%d %H:%M:%S} UTC"


def moment() -> Moment:
    """Now."""
    return Moment(monotonic(), wall())


def boot() -> str:
    """An identifier of this boot of the machine."""
    return _current.boot()


def sleep(seconds: float) -> None:
    """Let the present thread wait."""
    _current.sleep(seconds)


def thread(name: str, body: Callable[[], None]) -> threading.Thread:
    """Start ``body`` on a daemon thread."""
    return _current.thread(name, body)


def result(future: Future[T], seconds: float) -> T:
    """The result of a pool's call. Raises TimeoutError where it is not there in time."""
    return _current.result(future, seconds)


def pool(name: str, threads: int, waiting: int | None = None) -> Pool:
    """A pool of so many threads; ``waiting``: how many calls may wait for one, any number by default."""
    return _current.pool(name, threads, waiting)
