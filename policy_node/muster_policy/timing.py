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

    def line(self) -> str:
        """Median, 99th percentile and maximum of each kind as text [ms]."""
        parts = []
        for name, kept in self._kept.items():
            median, most, greatest = 1e3 * np.percentile(np.fromiter(kept, float), [50, 99, 100])
            parts.append(f"{name} p50 {median:.3f}, p99 {most:.3f}, max {greatest:.2f} ms")
        return "; ".join(parts) or "no step yet"
