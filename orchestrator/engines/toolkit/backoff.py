"""Backoff between retries: the intervals grow, and each failure is logged once instead of at every try."""

from __future__ import annotations

import logging
import threading
from collections.abc import Hashable
from dataclasses import dataclass

from orchestrator import machine


@dataclass
class _Trouble:
    failure: str
    pause: float
    next: float


class Backoff:
    """Present failures, by subject (a job, an engine, …). Any thread may call."""

    def __init__(self, log: logging.Logger, first: float = 1.0, most: float = 60.0) -> None:
        """``first``, ``most``: the shortest and the longest pause between two tries [s]; each failure doubles it."""
        self._log, self._first, self._most = log, first, most
        self._troubles: dict[Hashable, _Trouble] = {}
        self._lock = threading.Lock()

    def __bool__(self) -> bool:
        """Whether anything fails at present."""
        return bool(self._troubles)

    def failed(self, subject: Hashable, failure: str, error: BaseException | None = None, *, of: str = "") -> bool:
        """Note a failure; returns whether it differs from the subject's last one, and only then logs it.

        Args:
            subject: What failed.
            failure: One line, the same for the same failure.
            error: Where given, its traceback is logged too: a bug.
            of: What the log names before the failure, as ``job 3f0c``.
        """
        with self._lock:
            before = self._troubles.get(subject)
            pause = self._first if before is None else min(2 * before.pause, self._most)
            self._troubles[subject] = _Trouble(failure, pause, machine.monotonic() + pause)
        if before is not None and before.failure == failure:
            return False
        self._log.error("%s", f"{of}: {failure}" if of else failure, exc_info=error)
        return True

    def waits(self, subject: Hashable) -> bool:
        """Whether the pause after the last failure is not over."""
        trouble = self._troubles.get(subject)
        return trouble is not None and machine.monotonic() < trouble.next

    def pause(self, subject: Hashable) -> float:
        """Seconds until the next try of a subject; 0 where it may be tried now."""
        trouble = self._troubles.get(subject)
        return max(0.0, trouble.next - machine.monotonic()) if trouble else 0.0

    def failure(self, subject: Hashable) -> str | None:
        """The last failure; None where the subject works."""
        trouble = self._troubles.get(subject)
        return trouble.failure if trouble else None

    def pauses(self) -> dict[Hashable, float]:
        """Seconds until the next try of each subject that fails at present; 0 where it may be tried now."""
        with self._lock:
            return {subject: max(0.0, each.next - machine.monotonic()) for subject, each in self._troubles.items()}

    def hurry(self, subject: Hashable) -> None:
        """Something has changed: the next try need not wait."""
        with self._lock:
            if trouble := self._troubles.get(subject):
                trouble.next = 0.0

    def worked(self, subject: Hashable, *, lasting: bool = False) -> bool:
        """The subject works; returns whether it had failed before.

        ``lasting``: that it failed is forgotten only once it has worked for as long as the last pause, so that what fails at every
        other try is one failure.
        """
        trouble = self._troubles.get(subject)
        if trouble is None:  # the usual case, without the lock
            return False
        if lasting and machine.monotonic() < trouble.next + trouble.pause:
            return False
        with self._lock:
            return self._troubles.pop(subject, None) is not None

    def tidy(self, idle: float = 600.0) -> None:
        """Forget what was not tried for ``idle`` seconds after its pause, such as the start of a job that ended otherwise."""
        before = machine.monotonic() - idle
        with self._lock:
            self._troubles = {subject: each for subject, each in self._troubles.items() if each.next >= before}
