"""The alarm of the controller's loop: whatever changes something rings it, and the loop looks at once instead of at its next interval."""

from __future__ import annotations

import threading

from orchestrator.control.work_queue import WorkQueue


class Alarm:
    """Any thread may ring."""

    def __init__(self, work_queue: WorkQueue) -> None:
        self._work_queue, self._event = work_queue, threading.Event()

    @property
    def rings(self) -> bool:
        """Whether it has been rung since the last :meth:`clear`."""
        return self._event.is_set()

    def ring(self) -> None:
        """Something has changed."""
        self._event.set()

    def gang_changed(self, gang: str) -> None:
        """A gang has changed, by its name or that of its job; empty: what an engine has."""
        if gang:
            self._work_queue.hurry(gang.partition("/")[0])
        else:
            self._work_queue.version += 1  # a pass depends on it
        self.ring()

    def wait(self, seconds: float) -> bool:
        """Wait until it rings, or that long; returns whether it rings."""
        return self._event.wait(seconds)

    def clear(self) -> None:
        """What has rung so far is seen to."""
        self._event.clear()
