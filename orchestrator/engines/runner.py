"""The runner of an engine, with threads of its own: the controller reads the newest response, and never waits for an engine.

An engine that hangs (a Docker daemon that accepts connections and does not answer, a cloud behind a broken route) delays its own gangs
alone. Those keep the state that was seen last, and can still be timed out and asked to stop; gangs of other engines notice nothing.
"""

from __future__ import annotations

import errno
import logging
import threading
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
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
    StatusOrError,
    Transient,
)
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.engines.toolkit.statuses import status_of

log = logging.getLogger("muster.engines")

OVERDUE = 10.0
"""Seconds after which an engine whose call has not returned counts as not answering."""
_LAST_POLL = 60.0
"""Seconds that :meth:`Runner.stop` waits for the last status of a gang that was stopped."""
_CLOSING = 5.0
"""Seconds that :meth:`Runner.close` gives the call that is being carried out."""

_POLLS = "polls"
"""Subject of a failure to poll all gangs."""
_POLLING, _SELDOM = 50.0, 2.0
"""Pause between two polls of all gangs, in multiples of the processor time of the first, so that they take 2 % of a core; and its
limit [s]."""

_FINAL = frozenset(
    {
        errno.E2BIG,  # command and environment are larger than the kernel takes
        *(errno.EACCES, errno.EINVAL, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENOENT),
        *(errno.ENOEXEC, errno.ENOTDIR, errno.EPERM),
    }
)
"""Errors for which trying again is useless: what the job asks for does not exist, is not allowed, or is malformed.

Everything else may pass: no free descriptors, processes or memory (EMFILE, ENFILE, EAGAIN, ENOMEM), a volume that is full, read-only
or away (ENOSPC, EDQUOT, EROFS, EIO, ESTALE), a network that is down. To wait in vain, with a reason that says for what, costs
less than to fail a job that has done nothing wrong.
"""

T = TypeVar("T")


@dataclass(frozen=True)
class Health:
    """The state of an engine, for people."""

    reported_at: int | None
    """When it last reported its capacity, Unix time [ms]; None before the first time."""
    problem: str | None
    """That it does not answer, or why it can't report its capacity; None while it does."""
    failing: int
    """Gangs that it could not start, or look at, the last time; each is tried again."""
    retry: float | None
    """Seconds until the next of these tries; None where none fails."""


@dataclass
class _Observed:
    """A gang whose status the controller needs."""

    is_new: bool = True
    """It was not polled yet."""
    status: GangStatus | None = None
    requested_at: float = 0.0
    """When the engine was asked for that status (monotonic [s])."""


class Runner:
    """Carries out the calls of one engine, in their order, on a thread of its own, and its launches beside it. Any thread may ask."""

    def __init__(self, engine: Engine, changed: Callable[[str], None]) -> None:
        """``changed`` is called, on the engine's thread, when an answer differs from the one before: with the gang's name, or empty."""
        self.engine, self._changed = engine, changed
        self._lock = threading.Lock()
        self._launches: dict[str, Future[Handle]] = {}
        """By gang: its launch, under way or done, until the gang is over."""
        self._refused: dict[str, NotYet] = {}
        """By gang: what its last launch has to wait for."""
        self._observed: dict[Handle, _Observed] = {}
        self._is_polling = False
        self._next_poll = 0.0
        """When the next poll of all gangs is due (monotonic [s])."""
        self._reporting: Future[Capacity] | None = None
        self._capacity: Capacity | None = None
        self._reported_at: int | None = None
        self._backoff = Backoff(log)
        self._was_silent = False
        self._thread = machine.pool(f"engine {engine.name}", 1)
        at_once = engine.traits.launches
        self._launching = machine.pool(f"launch {engine.name}", at_once) if at_once > 1 else self._thread
        self.first = self.ask_capacity()
        """Done once the engine has reported its capacity for the first time, or has failed to."""

    def close(self) -> None:
        """Give the present call a few seconds, drop those that wait, and close the engine; its gangs go on."""
        for pool in {self._launching, self._thread}:
            pool.close(_CLOSING)
        self.engine.close()

    @property
    def silence(self) -> str | None:
        """That the engine does not answer, and since when; None while it does."""
        return self._silence_of(self._thread, "silence")

    @property
    def _any_silence(self) -> str | None:
        """The same, also of its launches where these have threads of their own."""
        return self.silence or (
            None if self._launching is self._thread else self._silence_of(self._launching, "launches")
        )

    def _silence_of(self, pool: machine.Pool, subject: str) -> str | None:
        since = pool.busy_since
        if since is None or (passed := machine.monotonic() - since) < OVERDUE:
            return None
        if (silence := self._backoff.failure(subject)) is None:
            began = machine.Moment(since, machine.wall() - passed)
            call = "" if pool is self._thread else " a launch"
            silence = f"the {self.engine.name} engine has not answered{call} since {began}"
            self._backoff.failed(subject, silence)
        return silence

    @property
    def unknown(self) -> str | None:
        """Why the engine's capacity is not known; None once it has reported it."""
        if self._capacity is not None:
            return None
        return self.silence or self._backoff.failure("hosts") or f"the {self.engine.name} engine has not answered yet"

    @property
    def health(self) -> Health:
        """The engine's answers just now."""
        problem = self._any_silence or self._backoff.failure("hosts") or self.unknown
        pauses = self._backoff.pauses()
        gangs = {subject[1]: pause for subject, pause in pauses.items() if isinstance(subject, tuple)}
        if _POLLS in pauses:
            gangs |= dict.fromkeys(self._observed, pauses[_POLLS])
        return Health(self._reported_at, problem, len(gangs), min(gangs.values(), default=None))

    # -- what the controller asks -------------------------------------------------------------------------------------

    def capacity(self, patience: float = 0.0) -> Capacity | None:
        """The hosts or limits that the engine reported last; None before the first report.

        Requests a newer report and waits for it at most ``patience`` seconds.
        """
        reporting = self.ask_capacity()
        if patience and not self.silence:
            wait([reporting], patience)
        return self._capacity

    def ask_capacity(self) -> Future[Capacity]:
        """Request a newer report of the capacity, unless one is under way; does not wait."""
        with self._lock:
            if self._reporting is None or self._reporting.done():
                self._reporting = self._submit(self._report_capacity)
            return self._reporting

    def plan(self, gang: Gang) -> Plan[Any]:
        """As the engine plans it, on the caller's thread. Raises EngineError."""
        return self._call("plan the gang", lambda: self.engine.plan(gang), lasting=True)

    def launch(self, gang: str, plan: Callable[[], Plan[Any]], again: bool = True) -> Handle:
        """The handle of the gang of that name once it is started. Raises NotYet until then, and EngineError.

        While the launch is under way, the message is empty until it is overdue.


        ``plan`` is called, on the caller's thread, where the gang's launch is not under way.
        ``again``: whether to try again where the last try has left nothing of the gang.
        """
        launch = self._launches.get(gang)
        if launch is None:
            refused = self._refused.get(gang)
            if refused and (self._backoff.waits(("launch", gang)) or not (again or refused.unknown)):
                raise refused.with_traceback(None)  # else it keeps the frames of every call
            try:
                planned = plan()
            except Transient as error:
                self._refused[gang] = error
                self._failed(("launch", gang), error)
                raise
            self._refused.pop(gang, None)
            launch = self._launches[gang] = self._submit(lambda: self._start(planned), self._launching)
            launch.add_done_callback(lambda _: self._changed(gang))
        if not launch.done():
            raise NotYet(self._any_silence or "", unknown=True)
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
        """The newest status of a gang; None before the first. From now on :meth:`poll` refreshes it.

        Nodes that were seen running, or not yet at all, are unreachable where there is no newer status, and say why.
        """
        if (known := self._observed.get(handle)) is None:
            with self._lock:
                known = self._observed[handle] = _Observed()
            self._submit(self._poll_new)
        status = known.status
        if trouble := self._trouble(handle):
            unknown = NodeStatus(NodePhase.UNREACHABLE, words=trouble)
            nodes = status or [unknown] * handle.nodes
            return [replace(each, phase=unknown.phase, words=trouble) if each.running else each for each in nodes]
        return status

    def poll(self) -> None:
        """Ask for newer statuses of all gangs that are observed, unless that is under way.

        Reports, too, that the engine has begun or ceased to be silent: its gangs look different then.
        """
        if self._was_silent != (self._any_silence is not None):
            self._was_silent = not self._was_silent
            for gang in {*self._launches, *(handle.gang for handle in self._observed)}:
                self._changed(gang)
        is_due = machine.monotonic() >= self._next_poll and not self._backoff.waits(_POLLS)
        if self._observed and is_due and not self._is_polling:
            self._is_polling = True
            self._submit(self._poll_all)

    def status_age(self, handle: Handle) -> float | None:
        """Seconds since the engine was asked for the newest status of the gang; None where it does not answer now."""
        known = self._observed.get(handle)
        if known is None or known.status is None or self._trouble(handle):
            return None
        return machine.monotonic() - known.requested_at

    def _trouble(self, handle: Handle) -> str | None:
        """Why there is no newer status of a gang."""
        return self.silence or self._backoff.failure(_POLLS) or self._backoff.failure(("poll", handle))

    def stop(self, handle: Handle, grace: float) -> GangStatus:
        """Stop the gang on the caller's thread, which may take long; returns its last status. Raises EngineError."""
        self._call("stop the gang", lambda: self.engine.stop(handle, grace))
        observing = self._submit(lambda: self._call("look at the gang", lambda: status_of(self.engine, handle)))
        try:
            return machine.result(observing, _LAST_POLL)
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
        self._backoff.worked(("launch", gang))
        self._backoff.worked(("poll", handle))

    # -- on the engine's threads --------------------------------------------------------------------------------------

    def _submit(self, body: Callable[[], T], pool: machine.Pool | None = None) -> Future[T]:
        subject = "silence" if pool in (None, self._thread) else "launches"

        def call() -> T:
            try:
                return body()
            except EngineError:
                raise
            except Exception:
                log.exception("a call of the %s engine failed", self.engine.name)
                raise
            finally:
                if self._backoff.worked(subject):
                    log.warning("the %s engine answers again", self.engine.name)

        return (pool or self._thread).submit(call)

    def _call(self, action: str, body: Callable[[], T], *, lasting: bool = False) -> T:
        """Carry out a call. Raises EngineError, whatever the engine raises.

        ``action``: for the message. ``lasting``: what would fail again is no :class:`Transient`: see ``_FINAL``, and a zero byte in an
        argument.
        """
        name = self.engine.name
        try:
            return body()
        except EngineError:
            raise
        except OSError as error:
            if lasting and error.errno in _FINAL:
                raise EngineError(str(error)) from error
            raise Transient(f"the {name} engine can't {action} now ({error}); trying again") from error
        except (Exception, SystemExit) as error:  # a library that wants to end the process must not end a thread
            if lasting and isinstance(error, ValueError):
                raise EngineError(str(error)) from error
            words = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
            raise EngineFault(
                f"the {name} engine failed to {action} ({words}); the controller's log has the details; trying again"
            ) from error

    def _failed(self, subject: Hashable, error: EngineError) -> None:
        self._backoff.failed(subject, str(error), error.__cause__ if isinstance(error, EngineFault) else None)

    def _report_capacity(self) -> Capacity:
        try:
            capacity = self._call("tell its hosts", self.engine.capacity)
        except EngineError as error:
            self._failed("hosts", error)
            raise
        self._backoff.worked("hosts")
        self._reported_at = int(machine.wall() * 1000)
        if capacity != self._capacity:
            self._capacity = capacity
            self._changed("")
        return capacity

    def _start(self, plan: Plan[Any]) -> Handle:
        subject = ("launch", plan.gang.name)
        try:
            handle = self._call("start the gang", lambda: self.engine.launch(plan), lasting=True)
        except Transient as error:
            self._failed(subject, error)
            raise
        self._backoff.worked(subject)
        return handle

    def _poll_new(self) -> None:
        """The first poll of all gangs that were not polled yet."""
        with self._lock:
            new = {handle: known for handle, known in self._observed.items() if known.is_new}
            for known in new.values():
                known.is_new = False
        if new:
            self._poll(list(new))

    def _poll_all(self) -> None:
        """One poll of all gangs. The more processor time it takes, the longer the pause until the next one."""
        began = machine.processor_time()
        try:
            self._poll([handle for handle in list(self._observed) if not self._backoff.waits(("poll", handle))])
        finally:
            pause = min(_POLLING * (machine.processor_time() - began), _SELDOM)
            self._next_poll, self._is_polling = machine.monotonic() + pause, False

    def _poll(self, handles: Sequence[Handle]) -> None:
        before = self._backoff.failure(_POLLS)
        requested_at = machine.monotonic()
        statuses: Sequence[StatusOrError] = ()
        try:
            statuses = self._call("look at its gangs", lambda: self._statuses(handles))
        except EngineError as error:
            self._failed(_POLLS, error)
        else:
            self._backoff.worked(_POLLS)
        changed = [
            handle
            for handle, status in zip(handles, statuses, strict=False)
            if self._note(handle, status, requested_at)
        ]
        for handle in changed if before == self._backoff.failure(_POLLS) else list(self._observed):
            self._changed(handle.gang)

    def _statuses(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        statuses = self.engine.observe(handles)
        if len(statuses) != len(handles):
            raise ValueError(f"{len(statuses)} statuses of {len(handles)} gangs")
        return statuses

    def _note(self, handle: Handle, status: StatusOrError, requested_at: float) -> bool:
        """Keep a status; returns whether it differs from the one before."""
        subject = ("poll", handle)
        with self._lock:
            if (known := self._observed.get(handle)) is None:
                return False  # it was forgotten meanwhile
            if not isinstance(status, BaseException):
                before, known.status, known.requested_at = known.status, status, requested_at
                return self._backoff.worked(subject) or before != status

        def fail() -> None:
            raise status

        try:
            self._call("look at the gang", fail)
        except EngineError as error:
            failure = self._backoff.failure(subject)
            self._failed(subject, error)
            return failure != self._backoff.failure(subject)
        return False
