"""Log lines, printed by a thread of their own: a stopped terminal must not stop the control loop."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

MOST = 1_000
"""Greatest number of waiting lines; later ones are dropped."""


class Lines:
    """Passes lines to a thread that prints them.

    Args:
        tell: Called with each line.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
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
            self._tell(line)
