"""Stops of gangs: each waits for its gang's grace time on a thread of its own; what the engine can't stop now is asked again."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from orchestrator import machine
from orchestrator.control.run_store import Key
from orchestrator.engines.api import EngineError, EngineFault, GangStatus
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.toolkit.backoff import Backoff

_THREADS = 128
"""Stops that are under way at once."""
_AGAIN, _RARELY = 2.0, 30.0
"""Seconds until another try to stop a gang that could not be stopped: at first, and at most."""


class Stops:
    """On the controller's thread alone, which never waits here."""

    def __init__(self, engine: EngineSet, changed: Callable[[str], None], log: logging.Logger) -> None:
        """``changed``: called, from any thread, with a job whose gang's stop has returned."""
        self._engine, self._changed = engine, changed
        self._denied = Backoff(log, _AGAIN, _RARELY)
        """Why the engine could not stop an attempt's gang when it was last asked."""
        self._under_way: dict[Key, Future[GangStatus]] = {}
        self._stopped: dict[Key, GangStatus] = {}
        self._pool = machine.pool("stop", _THREADS)

    def close(self) -> None:
        """Leave the stops that are under way to themselves."""
        self._pool.close()

    def ask(self, key: Key, handle: str, grace: float) -> GangStatus | None:
        """The last status of an attempt's gang, which is stopped now; None while it is not. The first call begins the stop.

        Args:
            key: The job's id and the attempt's number.
            handle: Of the gang, as its launch returned it.
            grace: Seconds from SIGTERM to SIGKILL.
        """
        if key in self._stopped:
            return self._stopped[key]
        if key not in self._under_way and not self._denied.waits(key):
            self._under_way[key] = self._pool.submit(partial(self._engine.stop, handle, grace))
            self._under_way[key].add_done_callback(partial(self._returned, key[0]))
        if key in self._under_way and self._under_way[key].done():
            stop = self._under_way.pop(key)
            if (error := stop.exception()) is None:
                self._stopped[key] = stop.result()
                return self._stopped[key]
            why = " ".join(str(error).split()).removesuffix("; trying again")
            said = f"job {key[0]}: attempt {key[1]} can't be stopped: {why}; trying again"
            expected = isinstance(error, EngineError) and not isinstance(error, EngineFault)
            self._denied.failed(key, said, None if expected else error)
        return None

    def trouble(self, key: Key) -> str | None:
        """Why the engine could not stop the gang when it was last asked; None where it has not failed."""
        said = self._denied.said(key)
        return said.removeprefix(f"job {key[0]}: ") if said else None

    def has_begun(self, key: Key) -> bool:
        """Whether a stop is under way or has ended the gang."""
        return key in self._under_way or key in self._stopped

    def pause(self, key: Key) -> float:
        """Seconds until the next try."""
        return self._denied.pause(key)

    def forget(self, key: Key) -> None:
        """The attempt is closed."""
        self._under_way.pop(key, None)
        self._stopped.pop(key, None)
        self._denied.worked(key)

    def _returned(self, job: str, _: object) -> None:
        self._changed(job)
