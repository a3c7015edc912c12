"""The cadence of saves: when the next checkpoint is due."""

from __future__ import annotations

import math
from collections.abc import Mapping

OVERHEAD = 0.01
"""Share of the time that ``every: auto`` spends on saving."""
_FIRST = 5
"""Iterations to the first save, and the minimum between two saves."""
_LONGEST = 1000


class Cadence:
    """Every so many iterations, or (``auto``) as often as :data:`OVERHEAD` allows (after CheckFreq, FAST'21)."""

    def __init__(self, every: int | str) -> None:
        self.auto = every == "auto"
        self.every = _FIRST if self.auto else int(every)
        self._last = 0

    def expects(self, iteration: int) -> bool:
        """Whether a save after ``iteration`` is likely, before its signals are known."""
        return iteration - self._last >= self.every if self.auto else iteration % self.every == 0

    def due(self, iteration: int, signals: Mapping[str, float]) -> bool:
        """Whether to save after ``iteration``. All ranks decide alike, since ``signals`` are sums over all of them."""
        if not self.auto:
            return iteration % self.every == 0
        if signals["stall"] > 0 and signals["iteration_seconds"] > 0:
            wanted = math.ceil(signals["stall"] / (OVERHEAD * signals["iteration_seconds"]))
            # not at once: if the loop only sometimes waits for the volume, the next save alone does not show it
            self.every = min(max(wanted, self.every // 2, _FIRST), _LONGEST)
        if iteration - self._last < self.every:
            return False
        self._last = iteration
        return True
