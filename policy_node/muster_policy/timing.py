"""A steady loop: its clock, statistics of its timing, and lines that are printed without stopping it."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

SPIN = 150e-6
"""Time before a deadline at which sleeping turns into polling the clock [s]."""
KEPT = 5_000
"""Number of times of each kind to keep: sorting more would take as long as a control step."""


def sleep_until(deadline: float) -> None:
    """Return at ``deadline`` [s, monotonic]: sleep, then poll the clock."""
    left = deadline - time.monotonic() - SPIN
    if left > 0.0:
        time.sleep(left)
    while time.monotonic() < deadline:
        pass


class Figures:
    """Times of the loop, the newest :data:`KEPT` of each kind."""

    def __init__(self) -> None:
        self._kept: dict[str, deque[float]] = {}

    def add(self, name: str, seconds: float) -> None:
        """Add a time [s]."""
        self._kept.setdefault(name, deque(maxlen=KEPT)).append(seconds)

    def line(self) -> str:
        """Median, 99th percentile and maximum of each kind as text [ms]."""
        parts = []
        for name, kept in self._kept.items():
            median, most, greatest = 1e3 * np.percentile(np.fromiter(kept, float), [50, 99, 100])
            parts.append(f"{name} p50 {median:.3f}, p99 {most:.3f}, max {greatest:.2f} ms")
        return "; ".join(parts) or "no step yet"


MOST = 1_000
"""Greatest number of waiting lines; later ones are dropped."""


class Lines:
    """Passes lines to a thread that prints them.

    Args:
        report: Called with each line.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._waiting: queue.Queue[str | None] = queue.Queue(MOST)
        self._thread = threading.Thread(target=self._work, name="lines", daemon=True)
        self._thread.start()

    def say(self, line: str) -> None:
        """Queue a line for printing; does not wait."""
        try:
            self._waiting.put_nowait(line)
        except queue.Full:
            pass  # no output is possible

    def close(self) -> None:
        """Wait until all lines are printed, a second at most."""
        try:
            self._waiting.put_nowait(None)
        except queue.Full:
            return
        self._thread.join(1.0)

    def _work(self) -> None:
        while (line := self._waiting.get()) is not None:
            self._report(line)
