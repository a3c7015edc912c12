"""Requests that take turns: their work is a process on the server's machine, and a waiting request holds a thread that others need."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from orchestrator.domain.errors import ClientError


class Turns:
    """At most ``at_once`` work at a time, and at most ``waiting`` others wait, for ``patience`` seconds each. Any thread may call."""

    def __init__(self, what: str, at_once: int = 2, waiting: int = 6, patience: float = 20.0) -> None:
        """``what``: the work that goes on now, for the message of a refusal."""
        self._what, self._patience = what, patience
        self._admitted, self._working = threading.Semaphore(at_once + waiting), threading.Semaphore(at_once)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Raises ClientError (429) where too many wait already, or it takes too long."""
        if not self._admitted.acquire(blocking=False):
            raise self._refusal()
        try:
            if not self._working.acquire(timeout=self._patience):
                raise self._refusal()
            try:
                yield
            finally:
                self._working.release()
        finally:
            self._admitted.release()

    def _refusal(self) -> ClientError:
        return ClientError(f"{self._what}; try again in a moment", 429)
