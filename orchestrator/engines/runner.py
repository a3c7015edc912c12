"""One thread for each engine: the controller asks, reads the newest answer, and never waits for an engine.

An engine that hangs (a Docker daemon that accepts connections and does not answer, a cloud behind a broken route) delays its own gangs
alone. Those keep the state that was seen last, and can still be timed out and asked to stop; gangs of other engines notice nothing.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import Any, TypeVar

from orchestrator import machine
from orchestrator.domain.hosts import Capacity
from orchestrator.engines.api import (
    Engine,
    EngineError,
    EngineFault,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    Transient,
)
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.engines.transience import is_final

log = logging.getLogger("muster.engines")

OVERDUE = 10.0
"""Seconds after which an engine whose call has not returned counts as not answering."""
_LAST_LOOK = 60.0
"""Seconds that :meth:`Runner.stop` waits for the last status of a gang that was stopped."""
_CLOSING = 5.0
"""Seconds that :meth:`Runner.close` gives the call that is being carried out."""

T = TypeVar("T")


@dataclass(frozen=True)
class Health:
    """The answers of an engine, as a person is told of them."""

    told_at: int | None
    """When it last reported its capacity, Unix time [ms]; None before the first time."""
    problem: str | None
    """That it does not answer, or why it can't report its capacity; None while it does."""
    failing: int
    """Gangs that it could not start, or look at, the last time; each is tried again."""
    retry: float | None
    """Seconds until the next of these tries; None where none fails."""


class Underway(NotYet):
    """The engine was asked to launch a gang and has not answered yet; the message is empty until it is overdue."""

    def __init__(self, message: str) -> None:
        super().__init__(message, unknown=True)


class Runner:
    """Carries out the calls of one engine, in their order, on a thread of its own. Any thread may ask."""

    def __init__(self, engine: Engine, changed: Callable[[str], None]) -> None:
        """``changed`` is called, on the engine's thread, when an answer differs from the one before: with the gang's name, or empty."""
        self.engine, self._changed = engine, changed
        self._lock = threading.Lock()
        self._launches: dict[str, Future[Handle]] = {}
        """By gang: its launch, under way or done, until the gang is over."""
        self._refused: dict[str, NotYet] = {}
        """By gang: what its last launch has to wait for."""
        self._observed: dict[Handle, None] = {}
        """Handles of the gangs whose status the controller wants."""
        self._looks: set[Handle] = set()
        """Those that are being looked at."""
        self._seen: dict[Handle, tuple[GangStatus, float]] = {}
        """By handle: the newest status, and when the engine was asked for it (monotonic [s])."""
        self._telling: Future[Capacity] | None = None
        self._capacity: Capacity | None = None
        self._told_at: int | None = None
        self._backoff = Backoff(log)
        self._was_silent = False
        self._thread = machine.pool(f"engine {engine.name}", 1)
        self.first = self.ask_capacity()
        """Done once the engine has told its capacity for the first time, or has failed to."""

    def close(self) -> None:
        """Give the present call a few seconds, drop those that wait, and close the engine; its gangs go on."""
        self._thread.close(_CLOSING)
        self.engine.close()

    @property
    def silence(self) -> str | None:
        """That the engine does not answer, and since when; None while it does."""
        since = self._thread.busy_since
        if since is None or (passed := machine.monotonic() - since) < OVERDUE:
            return None
        if (silence := self._backoff.failure("silence")) is None:
            began = machine.Moment(since, machine.wall() - passed)
            silence = f"the {self.engine.name} engine has not answered since {began}"
            self._backoff.failed("silence", silence)
        return silence

    @property
    def unknown(self) -> str | None:
        """Why it is not known what the engine has; None once it has told that."""
        if self._capacity is not None:
            return None
        return self.silence or self._backoff.failure("hosts") or f"the {self.engine.name} engine has not answered yet"

    @property
    def health(self) -> Health:
        """The engine's answers just now."""
        problem = self.silence or self._backoff.failure("hosts") or self.unknown
        gangs = {subject[1]: pause for subject, pause in self._backoff.pauses().items() if isinstance(subject, tuple)}
        return Health(self._told_at, problem, len(gangs), min(gangs.values(), default=None))

    # -- what the controller asks -------------------------------------------------------------------------------------

    def capacity(self, patience: float = 0.0) -> Capacity | None:
        """The hosts or limits that the engine reported last; None before the first report.

        Requests a newer report and waits for it at most ``patience`` seconds.
        """
        telling = self.ask_capacity()
        if patience and not self.silence:
            wait([telling], patience)
        return self._capacity

    def ask_capacity(self) -> Future[Capacity]:
        """Request a newer report of the capacity, unless one is under way; does not wait."""
        with self._lock:
            if self._telling is None or self._telling.done():
                self._telling = self._submit(self._tell_capacity)
            return self._telling

    def plan(self, gang: Gang) -> Plan[Any]:
        """As the engine plans it, on the caller's thread. Raises EngineError."""
        return self._call("plan the gang", lambda: _lasting(lambda: self.engine.plan(gang)))

    def launch(self, gang: str, plan: Callable[[], Plan[Any]], again: bool = True) -> Handle:
        """The handle of the gang of that name once it is started. Raises :class:`Underway` until then, NotYet and EngineError.

        ``plan`` is called, on the caller's thread, where the gang's launch is not under way. One thread launches.
        ``again``: whether to try again where the last try has left nothing of the gang.
        """
        launch = self._launches.get(gang)
        if launch is None:
            refused = self._refused.get(gang)
            if refused and (self._backoff.waits(("launch", gang)) or not (again or refused.unknown)):
                raise refused
            try:
                planned = plan()
            except Transient as error:
                self._refused[gang] = error
                self._failed(("launch", gang), error)
                raise
            self._refused.pop(gang, None)
            launch = self._launches[gang] = self._submit(lambda: self._start(planned))
            launch.add_done_callback(lambda _: self._changed(gang))
        if not launch.done():
            raise Underway(self.silence or "")
        try:
            return launch.result()  # again and again: the caller may not be able to record it
        except EngineError as error:
            del self._launches[gang]
            if isinstance(error, NotYet):
                self._refused[gang] = error
            raise

    def launch_pause(self, gang: str) -> float:
        """Seconds until the launch of a gang may be tried again; infinity while it is under way."""
        launch = self._launches.get(gang)
        return inf if launch is not None and not launch.done() else self._backoff.pause(("launch", gang))

    def observe(self, handle: Handle) -> GangStatus | None:
        """The newest status of a gang, of which :meth:`look` asks for newer ones from now on; None before the first.

        Nodes that were seen running, or not yet at all, are unreachable where there is no newer picture, and say why.
        """
        subject = ("look", handle)
        if handle not in self._observed:
            self._observed[handle] = None
            self.look([handle])
        seen, _ = self._seen.get(handle, (None, 0.0))
        if trouble := self.silence or self._backoff.failure(subject):
            away = NodeStatus(NodePhase.UNREACHABLE, words=trouble)
            return [
                replace(each, phase=away.phase, words=trouble) if each.running else each
                for each in seen or [away] * handle.nodes
            ]
        return seen

    def look(self, handles: Iterable[Handle] | None = None) -> None:
        """Ask for a newer status of these gangs, or of all that are observed; of none twice at a time.

        Reports, too, that the engine has begun or ceased to be silent: its gangs look different then.
        """
        if self._was_silent != (self.silence is not None):
            self._was_silent = not self._was_silent
            for gang in {*self._launches, *(handle.gang for handle in self._observed)}:
                self._changed(gang)
        for handle in list(self._observed) if handles is None else handles:
            if handle not in self._looks and not self._backoff.waits(("look", handle)):
                self._looks.add(handle)
                self._submit(partial(self._look, handle))

    def asked(self, handle: Handle) -> float | None:
        """Seconds since the engine was asked for the newest status of the gang; None where it does not answer now."""
        if handle not in self._seen or self.silence or self._backoff.failure(("look", handle)):
            return None
        return machine.monotonic() - self._seen[handle][1]

    def stop(self, handle: Handle, grace: float) -> GangStatus:
        """Stop the gang on the caller's thread, which may take long, and look at it once more. Raises EngineError."""
        self._call("stop the gang", lambda: self.engine.stop(handle, grace))
        looking = self._submit(lambda: self._call("look at the gang", lambda: self.engine.observe(handle)))
        try:
            return machine.result(looking, _LAST_LOOK)
        except TimeoutError:
            raise Transient(
                self.silence or f"the {self.engine.name} engine has not reported how the gang ended"
            ) from None

    def forget(self, gang: str, handle: Handle | None) -> None:
        """The gang is over; ``handle``: None where it was never launched."""
        with self._lock:
            self._launches.pop(gang, None)
            self._refused.pop(gang, None)
            if handle is not None:
                self._observed.pop(handle, None)
                self._seen.pop(handle, None)
        self._backoff.worked(("launch", gang))
        self._backoff.worked(("look", handle))

    # -- on the engine's thread ---------------------------------------------------------------------------------------

    def _submit(self, body: Callable[[], T]) -> Future[T]:
        def call() -> T:
            try:
                return body()
            except EngineError:
                raise
            except Exception:
                log.exception("a call of the %s engine failed", self.engine.name)
                raise
            finally:
                if self._backoff.worked("silence"):
                    log.warning("the %s engine answers again", self.engine.name)

        return self._thread.submit(call)

    def _call(self, what: str, body: Callable[[], T]) -> T:
        """Carry out a call. Raises EngineError, whatever the engine raises; ``what``: for the message."""
        name = self.engine.name
        try:
            return body()
        except EngineError:
            raise
        except OSError as error:
            raise Transient(f"the {name} engine can't {what} now ({error}); trying again") from error
        except (Exception, SystemExit) as error:  # a library that wants to end the process must not end a thread
            said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
            raise EngineFault(
                f"the {name} engine failed to {what} ({said}); the controller's log has the details; trying again"
            ) from error

    def _failed(self, subject: Hashable, error: EngineError) -> None:
        self._backoff.failed(subject, str(error), error.__cause__ if isinstance(error, EngineFault) else None)

    def _tell_capacity(self) -> Capacity:
        try:
            capacity = self._call("tell its hosts", self.engine.capacity)
        except EngineError as error:
            self._failed("hosts", error)
            raise
        self._backoff.worked("hosts")
        self._told_at = int(machine.wall() * 1000)
        if capacity != self._capacity:
            self._capacity = capacity
            self._changed("")
        return capacity

    def _start(self, plan: Plan[Any]) -> Handle:
        subject = ("launch", plan.gang.name)
        try:
            handle = self._call("start the gang", lambda: _lasting(lambda: self.engine.launch(plan)))
        except Transient as error:
            self._failed(subject, error)
            raise
        self._backoff.worked(subject)
        return handle

    def _look(self, handle: Handle) -> None:
        subject = ("look", handle)
        before = self._seen.get(handle, (None, 0.0))[0], self._backoff.failure(subject)
        asked = machine.monotonic()
        try:
            status = self._call("look at the gang", lambda: self.engine.observe(handle))
        except EngineError as error:
            self._failed(subject, error)
        else:
            self._backoff.worked(subject)
            with self._lock:
                if handle in self._observed:  # else it was forgotten meanwhile
                    self._seen[handle] = status, asked
        self._looks.discard(handle)
        if before != (self._seen.get(handle, (None, 0.0))[0], self._backoff.failure(subject)):
            self._changed(handle.gang)


def _lasting(body: Callable[[], T]) -> T:
    """Carry out ``body``. Raises EngineError for what would fail again: see :func:`is_final`, and a zero byte in an argument."""
    try:
        return body()
    except OSError as error:
        if is_final(error):
            raise EngineError(str(error)) from error
        raise
    except ValueError as error:
        raise EngineError(str(error)) from error
