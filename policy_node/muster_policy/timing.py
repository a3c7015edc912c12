"""A steady loop, and statistics of its timing."""

from __future__ import annotations

import time
from collections import deque

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

    def percentiles(self, name: str) -> tuple[float, float, float] | None:
        """Median, 99th percentile and maximum [s]; None without times."""
        kept = self._kept.get(name)
        if not kept:
            return None
        median, most, greatest = np.percentile(np.fromiter(kept, float), [50, 99, 100])
        return float(median), float(most), float(greatest)

    def line(self) -> str:
        """All of them as text [ms]."""
        parts = []
        for name in self._kept:
            found = self.percentiles(name)
            if found:
                parts.append(f"{name} p50 {found[0] * 1e3:.3f}, p99 {found[1] * 1e3:.3f}, max {found[2] * 1e3:.2f} ms")
        return "; ".join(parts) or "no step yet"

    def clear(self) -> None:
        """Delete all times."""
        self._kept.clear()
