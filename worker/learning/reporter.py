"""What a training tells the volume, on a thread of its own: training waits for neither disk nor network (a volume that is away for an
hour costs the run nothing but its newest metrics)."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any

from shared_store.epoch import StaleEpoch, check_epoch
from shared_store.layout import Run

_EVERY = 1.0
"""Seconds between two looks at the epoch."""
_MOST = 10_000
"""Pieces of work that are kept while the volume does not take them; later ones are dropped."""
_PATIENCE = 2.0
"""Seconds that a save waits for the records before it, which a resumed run would lack."""
_FAREWELL = 30.0
"""Seconds that the end of a training waits for the volume to take the last records."""


class Fence:
    """Looks once a second whether a newer attempt owns the run: a rank that was frozen for long sees it at once."""

    def __init__(self, run: Run, epoch: int) -> None:
        self._run, self._epoch = run, epoch
        self._stale: StaleEpoch | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="fence", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raises StaleEpoch where a newer attempt owned the run when it was last looked."""
        if self._stale is not None:
            raise self._stale

    def close(self) -> None:
        """Look no more."""
        self._over.set()

    def _watch(self) -> None:
        while not self._over.is_set():
            # a volume that is away for a while: the next look reads it again
            with contextlib.suppress(OSError, ValueError):
                try:
                    check_epoch(self._run, self._epoch)
                except StaleEpoch as error:
                    self._stale = error
                    return
            self._over.wait(_EVERY)


class Reporter:
    """Does what it is told, in order, on a thread of its own: prints and writes of which training needs no answer."""

    def __init__(self) -> None:
        self._work: queue.Queue[tuple[Callable[..., object], tuple[Any, ...]]] = queue.Queue(_MOST)
        self._dropped = 0
        threading.Thread(target=self._run, name="reporter", daemon=True).start()

    def do(self, function: Callable[..., object], *arguments: Any) -> None:
        """Have ``function`` called; does not wait. It must not raise."""
        try:
            self._work.put_nowait((function, arguments))
        except queue.Full:  # there is nobody to tell: what would print it is what hangs
            self._dropped += 1

    def flush(self, seconds: float = _PATIENCE) -> bool:
        """Wait until all is done, for at most so long; whether it is."""
        done = threading.Event()
        self.do(done.set)
        return done.wait(seconds)

    def close(self) -> None:
        """Wait for what is left, for a while."""
        if not self.flush(_FAREWELL) or self._dropped:
            print(f"warning: the volume did not take the last metrics ({self._dropped} were dropped)", flush=True)

    def _run(self) -> None:
        while True:
            function, arguments = self._work.get()
            function(*arguments)
