"""View of a backend: the last response of one that is slow to read: its value, its age, and why there is no newer one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from math import inf
from typing import Generic, TypeVar

from orchestrator import machine
from orchestrator.engines.api import EngineError

T = TypeVar("T")


class CachedView(Generic[T]):
    """A value that is read on a thread of its own once it is too old: a backend that hangs delays one caller, once. Any thread may call."""

    def __init__(self, value: T, read: Callable[[], T], *, name: str, silence: str, patience: float) -> None:
        """Args:
        value: That before the first response.
        read: Asks the backend. Raises EngineError.
        name: Of the thread.
        silence: The trouble while a response is late, in words.
        patience: Seconds that a caller waits for a response; then it is late.
        """
        self.value, self._read, self._silence, self._patience = value, read, silence, patience
        self.taken = self._tried = -inf
        """When the value was requested [monotonic s]; -inf before the first response."""
        self.trouble = ""
        """Why there is no newer value; empty while the last attempt to read it has succeeded."""
        self._lock = threading.Lock()
        self._pool = machine.pool(name, 1)
        self._reading: Future[T] | None = None

    def read(self) -> T:
        """The value as it is now, read on the caller's thread. Raises EngineError: the last one stays, and is stale."""
        started = machine.monotonic()
        try:
            value = self._read()
        except Exception as error:
            words = str(error) if isinstance(error, EngineError) else f"{type(error).__name__}: {error}"
            self.trouble, self._tried = words, machine.monotonic()
            raise
        if started >= self.taken:
            self.value, self.taken, self._tried, self.trouble = value, started, started, ""
        return value

    def get(self, age: float) -> T:
        """The value; read again where it, and the last failure, are older than ``age`` [s]. ``trouble`` says whether it is stale."""
        with self._lock:
            reading = self._reading
            if (reading is None or reading.done()) and machine.monotonic() - self._tried > age:
                reading = self._reading = self._pool.submit(self.read)
                trouble = ""
            else:
                trouble = self.trouble
        if reading is not None and not trouble:
            try:
                with suppress(EngineError):
                    machine.result(reading, self._patience)
            except TimeoutError:
                self.trouble = self._silence
        return self.value
