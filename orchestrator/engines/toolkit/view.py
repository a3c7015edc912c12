"""A view of a backend that is slow to ask: its last answer, the answer's age, and why there is no newer one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from math import inf
from typing import Generic, TypeVar

from orchestrator import machine
from orchestrator.engines.api import EngineError

T = TypeVar("T")


class View(Generic[T]):
    """A value that is told from outside. Any thread may call."""

    def __init__(self, value: T) -> None:
        """``value``: that until the first answer."""
        self._lock = threading.Lock()
        self._answer = value, -inf
        self._missed: tuple[str, float] | None = None

    @property
    def value(self) -> T:
        """The last answer's, however old it is."""
        return self._answer[0]

    @property
    def taken(self) -> float:
        """The time of the last answer [monotonic s]; -inf before the first."""
        return self._answer[1]

    @property
    def age(self) -> float:
        """Seconds since the last answer; infinite before the first."""
        return machine.monotonic() - self.taken

    @property
    def trouble(self) -> str | None:
        """Why there is no newer answer; None while the last attempt to read it has succeeded."""
        return self._missed[0] if self._missed else None

    def answered(self, value: T, taken: float | None = None) -> None:
        """Keep an answer, unless a newer one is there; ``taken``: when it was asked for [monotonic s], now by default."""
        with self._lock:
            at = machine.monotonic() if taken is None else taken
            if at > self.taken:
                self._answer, self._missed = (value, at), None

    def missed(self, why: str) -> None:
        """Note that no answer came; the last value stays, and is stale."""
        with self._lock:
            self._missed = why, machine.monotonic()


class CachedView(View[T]):
    """A value that is read on a thread of its own once it is too old: a backend that hangs delays no caller for long."""

    def __init__(self, value: T, read: Callable[[], T], *, name: str, silence: str, overdue: float = 0.0) -> None:
        """Args:
        value: That until the first answer.
        read: Asks the backend. Raises EngineError.
        name: Of the thread.
        silence: The trouble while an answer is late, in words.
        overdue: Seconds that an answer may take before it is late.
        """
        super().__init__(value)
        self._read, self._name, self._silence, self._overdue = read, name, silence, overdue
        self._asked = 0.0
        self._idle = threading.Event()
        self._idle.set()
        self._late = False
        """A caller has waited in vain for the reading that is under way: later ones take the value as it is."""

    @property
    def trouble(self) -> str | None:
        is_overdue = self._late and machine.monotonic() - self._asked >= self._overdue
        return super().trouble or (self._silence if is_overdue else None)

    def read(self) -> T:
        """The value as it is now, read on the caller's thread. Raises EngineError."""
        started = machine.monotonic()
        try:
            value = self._read()
        except EngineError as error:
            self.missed(str(error))
            raise
        self.answered(value, started)
        return value

    def get(self, age: float, patience: float = 0.0) -> T:
        """The value; a newer one is asked for where it, and the last failure, are older than ``age`` [s].

        ``patience``: seconds to wait for that one, at most. Where ``trouble`` says why there is none, the value is stale.
        """
        tried = max(self.taken, self._missed[1] if self._missed else -inf)
        if machine.monotonic() - tried > age:
            self.refresh(patience)
        return self.value

    def refresh(self, patience: float = 0.0) -> None:
        """Ask for a newer value, unless that is under way, and wait for it at most ``patience`` seconds."""
        with self._lock:
            if self._idle.is_set():
                self._idle.clear()
                self._asked = machine.monotonic()
                machine.thread(self._name, self._run)
        if patience and not self._late and not self._idle.wait(patience):
            self._late = True

    def _run(self) -> None:
        try:
            self.read()
        except EngineError:
            pass  # noted
        except Exception as error:  # a bug must not leave the view waiting for ever
            self.missed(f"{type(error).__name__}: {error}")
            raise
        finally:
            self._late = False
            self._idle.set()
