"""Stops of gangs: each waits for its gang's grace time on a pool of threads; what the engine can't stop now is asked again."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from math import inf

from orchestrator import machine
from orchestrator.control.run_store import Key
from orchestrator.engines.api import EngineError, EngineFault, GangStatus, read_handle
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.machine import Pool

_THREADS = 128
"""Stops that are under way at once on one engine: those on another one wait for none of them."""
_QUIET = 1.0
"""Seconds for which a stop may wait for its turn before its job says so."""
_AGAIN, _RARELY = 2.0, 30.0
"""Seconds until another try to stop a gang that could not be stopped: at first, and at most."""


@dataclass(frozen=True)
class _Stop:
    """A stop that was requested."""

    engine: str
    waited: bool
    """Whether all threads for the engine were busy."""
    requested_at: float
    """When it was requested (monotonic [s])."""
    result: Future[GangStatus]

    @property
    def unreported(self) -> float:
        """Seconds until its job says that it waits, or has waited; 0 from then on."""
        return max(0.0, self.requested_at + _QUIET - machine.monotonic()) if self.waited else inf


class Stops:
    """On the controller's thread alone, which never waits here."""

    def __init__(self, engine: EngineSet, changed: Callable[[str], None], log: logging.Logger) -> None:
        """``changed``: called, from any thread, with a job whose gang's stop has returned, or begins after it had to wait."""
        self._engine, self._changed = engine, changed
        self._denied = Backoff(log, _AGAIN, _RARELY)
        """Why the engine could not stop an attempt's gang when it was last asked."""
        self._under_way: dict[Key, _Stop] = {}
        self._busy = Counter[str]()
        """Stops that are under way, by engine."""
        self._stopped: dict[Key, GangStatus] = {}
        self._pools: dict[str, Pool] = {}
        """By engine."""

    def close(self) -> None:
        """Leave the stops that are under way to themselves."""
        for pool in self._pools.values():
            pool.close()

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
            self._begin(key, handle, grace)
        if key in self._under_way and self._under_way[key].result.done():
            stop = self._take(key).result
            if (error := stop.exception()) is None:
                self._stopped[key] = stop.result()
                return self._stopped[key]
            why = " ".join(str(error).split()).removesuffix("; trying again")
            failure = f"attempt {key[1]} can't be stopped: {why}; trying again"
            expected = isinstance(error, EngineError) and not isinstance(error, EngineFault)
            self._denied.failed(key, failure, None if expected else error, of=f"job {key[0]}")
        return None

    def reason(self, key: Key) -> str | None:
        """Why the gang is not stopped yet, for the job's user; None where nothing is amiss."""
        if failure := self._denied.failure(key):
            return failure
        stop = self._under_way.get(key)
        if stop is None or stop.unreported:
            return None
        if not (stop.result.running() or stop.result.done()):
            return f"attempt {key[1]} waits for its turn to be stopped: the {stop.engine} engine is stopping {_THREADS} others"
        return f"attempt {key[1]} is being stopped"

    def has_started(self, key: Key) -> bool:
        """Whether a stop waits for its turn, is under way or has ended the gang."""
        return key in self._under_way or key in self._stopped

    def pause(self, key: Key) -> float:
        """Seconds until the next try, or until the job says that the stop waits; infinity where neither comes."""
        if key in self._stopped:
            return inf
        if (stop := self._under_way.get(key)) is not None:
            return stop.unreported or inf
        return self._denied.pause(key)

    def forget(self, key: Key) -> None:
        """The attempt is closed."""
        if key in self._under_way:
            self._take(key)
        self._stopped.pop(key, None)
        self._denied.worked(key)

    def _begin(self, key: Key, handle: str, grace: float) -> None:
        engine = read_handle(handle).engine
        if engine not in self._pools:
            self._pools[engine] = machine.pool(f"stop {engine}", _THREADS)
        waits = self._busy[engine] >= _THREADS
        self._busy[engine] += 1
        requested_at = machine.monotonic()
        result = self._pools[engine].submit(partial(self._stop, key[0], handle, grace, requested_at if waits else inf))
        self._under_way[key] = _Stop(engine, waits, requested_at, result)
        result.add_done_callback(lambda _: self._changed(key[0]))

    def _take(self, key: Key) -> _Stop:
        stop = self._under_way.pop(key)
        self._busy[stop.engine] -= 1
        return stop

    def _stop(self, job: str, handle: str, grace: float, waits_since: float) -> GangStatus:
        if machine.monotonic() - waits_since >= _QUIET:
            self._changed(job)
        return self._engine.stop(handle, grace)
