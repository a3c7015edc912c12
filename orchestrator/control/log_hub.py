"""The hub of followed logs: nodes push their lines over the bus, and one reader a job fills what is missing for all followers.

While a client follows a job, its nodes are asked to push (:data:`shared_store.contract.bus.LOG_LEASE`), and each tells once a second where its log
ends. As long as all of them do and nothing is missing, no file is polled. Otherwise (no bus, an engine without one, a lost push, a
supervisor that knows no pushes) one poll of the files serves all followers of the job. Files stay the truth.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol

from orchestrator import machine
from orchestrator.control.bus import Bus
from orchestrator.control.log_tail import MOST, JobLogs
from orchestrator.control.store_calls import StoreCalls, StoreSilent
from orchestrator.domain.job import Status
from orchestrator.persistence.queries import states_of
from orchestrator.persistence.session import Database, DatabaseError
from shared_store.contract.bus import LOG_LEASE
from shared_store.contract.bus import Node as Address
from shared_store.volume.layout import Run

_MEMORY = 32 << 20
"""Bytes that all tails together keep, with what came too early, whatever their number."""
_POLL, _POLL_SELDOM = 0.05, 1.0
"""Seconds between two polls of the files of a job whose nodes do not push: after a change, and at last while polls find nothing."""
_OF_SILENCE = 0.1
"""In between: this part of the time since a poll found something. So a line is late by at most a tenth of the silence before it."""
_SHARE = 0.005
"""Seconds between two polls, for each job that is polled: all of them together are polled 200 times a second."""
_AGAIN = 1.0
"""Seconds until a store or a database that can't be read is tried again."""
_ROWS = 10.0
"""Seconds after which the rows of all followed jobs are read, whether a commit has reported a change or not."""
_TICK = 1.0
"""Seconds between two rounds in which nothing happens."""
_ASK, _ASK_SELDOM = 0.5, LOG_LEASE / 2
"""Seconds after which nodes are asked again to push that do not, at first and at last; the second also for those that do."""

log = logging.getLogger("muster.controller")


class Waker:
    """Wakes one follower, who waits on an event loop. Any thread may wake it."""

    def __init__(self) -> None:
        self._is_awake = False
        self._waits: tuple[asyncio.AbstractEventLoop, asyncio.Future[None]] | None = None

    def wake(self) -> None:
        if self._is_awake:
            return
        self._is_awake = True
        if (waits := self._waits) is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                waits[0].call_soon_threadsafe(_resolve, waits[1])

    async def wait(self, seconds: float) -> None:
        """Until it is woken, or was since the last wait; at most so many seconds."""
        loop = asyncio.get_running_loop()
        future = loop.create_future()
        timer = loop.call_later(seconds, _resolve, future)
        self._waits = loop, future
        try:
            if not self._is_awake:
                await future
        finally:
            self._waits = None
            timer.cancel()
        self._is_awake = False


def _resolve(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


class Wakes(Protocol):
    def wake(self) -> None: ...


class _Followed:
    """A job that is followed."""

    def __init__(self, run: Run, job: str) -> None:
        self.logs = JobLogs(run, job)
        self.wakers: list[Wakes] = []
        self.is_changed = True
        """Whether its row has to be read."""
        self.is_polled = False
        """Whether a poll is under way."""
        self.polled = float("-inf")
        """When the last poll ended [s]."""
        self.found = machine.monotonic()
        """When a poll has found something, or the last attempt has begun [s]."""
        self.pause = 0.0
        """Seconds from the last poll to the next one."""
        self.next_ask = 0.0
        self.asking = _ASK

    def wake(self) -> None:
        for each in list(self.wakers):
            each.wake()

    def poll_soon(self) -> None:
        """Something has happened to the logs."""
        self.pause = min(self.pause, _POLL)


class LogHub:
    """All followers of one controller. Any thread may call."""

    def __init__(self, database: Database, bus: Bus, calls: StoreCalls) -> None:
        self._database, self._bus, self._calls = database, bus, calls
        self._lock = threading.Condition()
        self._followed: dict[str, _Followed] = {}
        self._watching: list[Wakes] = []
        self._thread: threading.Thread | None = None
        self._is_closing = self._is_due = False
        self._read_at = 0.0
        """When the rows of all jobs were read (monotonic [s])."""
        bus.pushed, bus.stated, bus.is_followed = self._pushed, self._stated, self._followed.__contains__

    @contextmanager
    def follow(self, run: Run, job: str, waker: Wakes) -> Iterator[JobLogs]:
        """The newest part of a job's logs while the block runs; ``waker`` is woken whenever something is new, and when the job is over."""
        with self._lock:
            followed = self._followed.setdefault(job, _Followed(run, job))
            followed.wakers.append(waker)
            if self._thread is None:
                self._thread = machine.thread("log hub", self._run)
            self._hurry()
        try:
            yield followed.logs
        finally:
            with self._lock:
                followed.wakers.remove(waker)
                if not followed.wakers and self._followed.get(job) is followed:
                    del self._followed[job]

    @contextmanager
    def watch(self, waker: Wakes) -> Iterator[None]:
        """A block in which ``waker`` is woken whenever any job has changed."""
        with self._lock:
            self._watching.append(waker)
        try:
            yield
        finally:
            with self._lock:
                self._watching.remove(waker)

    def changed(self, jobs: Iterable[str]) -> None:
        """A commit has changed these jobs."""
        with self._lock:
            for followed in filter(None, map(self._followed.get, jobs)):
                followed.is_changed = True
                self._hurry()
            watching = list(self._watching)
        for waker in watching:
            waker.wake()

    def close(self) -> None:
        """Wake all followers, for the last time."""
        with self._lock:
            self._is_closing = True
            self._hurry()
            wakers = [*self._watching, *(waker for each in self._followed.values() for waker in each.wakers)]
        for waker in wakers:
            waker.wake()

    # what nodes tell, on the network's thread

    def _pushed(self, node: Address, position: int, data: bytes) -> None:
        if (followed := self._followed.get(node[0])) is not None:
            followed.poll_soon()
            if followed.logs.push(node[1:], position, data):
                followed.wake()
            else:  # something before it is missing
                self._hurry_locked()

    def _stated(self, node: Address, end: int | None, is_whole: bool) -> None:
        if (followed := self._followed.get(node[0])) is not None and followed.logs.state(node[1:], end, is_whole):
            followed.poll_soon()
            self._hurry_locked()

    # the hub's thread

    def _hurry(self) -> None:
        self._is_due = True
        self._lock.notify()

    def _hurry_locked(self) -> None:
        with self._lock:
            self._hurry()

    def _run(self) -> None:
        """Rounds while a job is followed, each as soon as one is due."""
        pause = 0.0
        while True:
            with self._lock:
                if not self._is_due:
                    self._lock.wait(pause)
                self._is_due = False
                if self._is_closing or not self._followed:
                    self._thread = None
                    return
                followed = list(self._followed.values())
            try:
                pause = self._round(followed)
            except Exception:
                log.exception("followers of logs have to wait")
                pause = _AGAIN

    def _round(self, followed: Collection[_Followed]) -> float:
        """Read changed rows, ask nodes to push, and poll the files of jobs whose nodes do not; returns the seconds until the next one."""
        if is_late := machine.monotonic() - self._read_at > _ROWS:
            self._read_at = machine.monotonic()
        self._read_rows([each for each in followed if each.is_changed or is_late])
        share = _MEMORY // (3 * sum(max(1, len(each.logs)) for each in followed))
        for each in followed:
            each.logs.keep(min(MOST, share))
        now, due = machine.monotonic(), machine.monotonic() + _TICK
        polled_jobs = [each for each in followed if not each.logs.is_over and not each.logs.delivers()]
        for each in followed:
            if now >= each.next_ask and (attempt := each.logs.attempt) is not None:
                self._ask(each, attempt, now)
        for each in polled_jobs:
            if each.is_polled:
                continue
            if now >= (next_poll := each.polled + max(each.pause, _SHARE * len(polled_jobs))):
                self._poll(each)
            else:
                due = min(due, next_poll)
        return max(0.0, due - now)

    def _read_rows(self, changed: Collection[_Followed]) -> None:
        if not changed:
            return
        for each in changed:
            each.is_changed = False
        by_job = {each.logs.job: each for each in changed}
        try:
            with self._database.session() as session:
                found = states_of(session, by_job)
        except DatabaseError:
            for each in changed:  # the next round tries again
                each.is_changed = True
            return
        for job, each in by_job.items():
            status, attempt, nodes = found.get(job, (Status.FAILED, None, 0))
            is_over = status.is_terminal
            if each.logs.note(attempt, nodes) or is_over:
                each.next_ask, each.pause, each.asking, each.found = 0.0, 0.0, _ASK, machine.monotonic()
                each.logs.is_over = is_over
                each.wake()

    def _ask(self, each: _Followed, attempt: int, now: float) -> None:
        """Ask the nodes of the open attempt to push their logs."""
        each.asking = _ASK_SELDOM if each.logs.is_connected() else min(2 * each.asking, _ASK_SELDOM)
        each.next_ask = now + each.asking
        self._bus.ask_for_logs(each.logs.job, attempt)

    def _poll(self, each: _Followed) -> None:
        def poll() -> None:
            pause = _AGAIN
            try:
                is_new, now = each.logs.poll(), machine.monotonic()
                if is_new:
                    each.found = now
                    each.wake()
                pause = min(max(_POLL, _OF_SILENCE * (now - each.found)), _POLL_SELDOM)
            except OSError:
                pass
            finally:
                # what has happened meanwhile may have asked for an earlier one
                each.polled, each.pause, each.is_polled = machine.monotonic(), min(each.pause, pause), False
                self._hurry_locked()

        each.is_polled, each.pause = True, _POLL_SELDOM
        try:
            self._calls.submit(poll)
        except StoreSilent:
            each.polled, each.pause, each.is_polled = machine.monotonic(), _AGAIN, False
