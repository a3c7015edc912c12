"""The users of a run: requests that read it, or the one that deletes it. Of these, the first keeps out the others.

A request that continues, clones, registers or cites a run uses it from its first look at the store until its answer. A job that was
submitted needs no entry: its row is what keeps its runs (:mod:`orchestrator.persistence.retention_rows`).
"""

from __future__ import annotations

import threading
from array import array
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from orchestrator.domain.errors import RequestError

_VERSIONS = 4096
"""Runs share so many versions, so that deletions leave nothing in memory: another run's change costs a request a second look at the store."""


class RunInUse(RequestError):
    """The run is being deleted, or archived, now; one line."""

    status = 409


class RunUsers:
    """Of the runs of one controller. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = Counter[str]()
        self._taken: set[str] = set()
        self._versions = array("Q", bytes(8 * _VERSIONS))

    @contextmanager
    def using(self, run: str) -> Iterator[None]:
        """A block in which nobody deletes the run. Raises RunInUse where that has begun."""
        with self._lock:
            self._check(run)
            self._users[run] += 1
        try:
            yield
        finally:
            with self._lock:
                self._users[run] -= 1
                if not self._users[run]:
                    del self._users[run]

    def check(self, run: str) -> None:
        """Raises RunInUse where the run is being deleted or archived."""
        with self._lock:
            self._check(run)

    def version(self, run: str) -> int:
        """Another number after each deletion of the run: what was read of the store before counts no more."""
        with self._lock:
            return self._versions[hash(run) % _VERSIONS]

    def take(self, run: str) -> bool:
        """Have the run for oneself until :meth:`let_go`; False where a request uses it."""
        with self._lock:
            if run in self._users or run in self._taken:
                return False
            self._taken.add(run)
            self._versions[hash(run) % _VERSIONS] += 1
            return True

    def let_go(self, run: str) -> None:
        """Others may use it again."""
        with self._lock:
            self._taken.discard(run)

    def _check(self, run: str) -> None:
        if run in self._taken:
            raise RunInUse(f"run {run} is being deleted or archived now; try again in a moment")
