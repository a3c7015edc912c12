"""How long a rank took to start."""

from __future__ import annotations

import os
import time
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worker.learning.hooks import Hook

if TYPE_CHECKING:
    from worker.learning.loop import Loop


class Startup(Hook):
    """Prints the parts of a start after the first iteration, in the order of :meth:`mark`. Main rank only."""

    def __init__(self) -> None:
        self._marks = [("", _own_start())]
        self._loop: Loop | None = None

    def mark(self, part: str) -> None:
        """The end of a part: it began at the end of the one before, the first with this process."""
        self._marks.append((part, time.clock_gettime(time.CLOCK_BOOTTIME)))

    def begin(self, loop: Loop) -> None:
        self._loop = loop if loop.gang.is_main else None

    def iteration(self, record: dict[str, Any]) -> None:
        if self._loop is None:
            return
        self.mark("first iteration")
        parts = [f"{part} {end - start:.2f} s" for (_, start), (part, end) in pairwise(self._marks)]
        self._loop.say(f"started in {self._marks[-1][1] - self._marks[0][1]:.2f} s: {', '.join(parts)}")
        self._loop = None


def _own_start() -> float:
    """When this process was started, or forked, in seconds since boot."""
    ticks = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]  # starttime in proc(5)
    return int(ticks) / os.sysconf("SC_CLK_TCK")
