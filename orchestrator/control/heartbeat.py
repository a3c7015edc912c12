"""The heartbeat of the controller's loop: the loop leaves signs of life, and any thread reads them without waiting."""

from __future__ import annotations

from orchestrator import machine

LATE = 5.0
"""Seconds without progress after which the loop counts as stuck."""


class Heartbeat:
    """When the loop made its last progress."""

    def __init__(self) -> None:
        self._last: float | None = None

    def beat(self) -> None:
        """The loop goes on."""
        self._last = machine.monotonic()

    @property
    def age(self) -> float:
        """Seconds since the last progress; 0 before the loop begins."""
        return 0.0 if self._last is None else max(0.0, machine.monotonic() - self._last)

    def problem(self) -> str | None:
        """Why the loop counts as stuck; None while it goes on."""
        age = self.age
        if age <= LATE:
            return None
        return f"the controller's loop has made no progress for {age:.0f} s; if that lasts, restart the controller"
