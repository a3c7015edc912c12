"""The store as the controller's loop uses it: each call is carried out on a thread of a pool, since the volume may hang.

What is missing on a volume may be missing because the volume is: each answer counts only if the store is still the one that the
controller knows, after it was read.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from math import inf
from typing import Any, TypeVar

from orchestrator import machine
from orchestrator.control.peers import Peers
from orchestrator.domain.attempt_events import Delayed
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.machine import Pool
from shared_store.checkpoints import DamagedCheckpoint, list_checkpoints
from shared_store.epoch import Claim, StaleEpoch, close_claim, read_epoch, take_epoch
from shared_store.files import DamagedFile
from shared_store.layout import Run, Store, StoreError
from shared_store.outcomes import Outcome, read_outcome

log = logging.getLogger("muster.controller")

T = TypeVar("T")
Key = tuple[str, int]
"""Job and number of an attempt."""
OVERDUE = 10.0
"""Seconds after which a store whose call has not returned counts as not answering."""


class StoreUnavailable(Exception):
    """The store can't be used now; the message says why. The action is tried again."""


class RunRefused(Exception):
    """The run can't be used for good; the message says why."""


@dataclass(frozen=True)
class RunFacts:
    """A run as it was found; a :class:`shared_store.layout.Run` for those who only read its ``run.json``."""

    name: str
    missing: bool
    content: Mapping[str, Any] | None
    """Its ``run.json``; None where there is none, or where it is damaged."""
    damage: str = ""
    epoch: int = 0
    writer: str | None = None
    """The attempt of another controller that writes it now, in words."""

    def is_missing(self) -> bool:
        return self.missing

    def description(self) -> Mapping[str, Any] | None:
        """Raises DamagedFile."""
        if self.damage:
            raise DamagedFile(self.damage)
        return self.content


def facts_of(run: Run) -> RunFacts:
    """A run as the store has it now. Raises OSError."""
    try:
        content, damage = run.description(), ""
    except (ValueError, RecursionError) as error:
        content, damage = None, str(error)
    return RunFacts(run.name, run.is_missing(), content, damage)


@dataclass(frozen=True)
class Progress:
    """What a run holds after an attempt."""

    iteration: int | None = None
    """Of its newest checkpoint; None where it has none."""
    saved: float | None = None
    """When the attempt made its newest checkpoint (Unix time [s]); None where it made none."""


class RunStore:
    """Calls on the store. Every method may hang; all raise StoreUnavailable."""

    def __init__(self, store: Store, peers: Peers, check: Callable[[], None] = lambda: None) -> None:
        """``check``: raises OSError where the volume of the store is not there, or another one is."""
        self.store, self.peers, self._check = store, peers, check

    def examine(self, name: str) -> RunFacts:
        """A run before an attempt begins. Raises RunRefused."""
        with self._using(f"read run {name}"):
            run = self.store.run(name)
            return replace(facts_of(run), epoch=read_epoch(run), writer=self.peers.writer(run))
        raise AssertionError

    def claim(self, name: str, description: Mapping[str, Any], after: int, claim: Claim) -> int:
        """Create the run, where it is missing, and give it to an attempt; returns the epoch, greater than ``after``. Raises RunRefused."""
        with self._using(f"prepare run {name}"):
            run = self.store.run(name)
            run.create(dict(description))
            return take_epoch(run, after, claim)
        raise AssertionError

    def outcomes(self, name: str, job: str, attempt: int, nodes: Sequence[int]) -> Mapping[int, Outcome]:
        """The outcomes of those of these nodes that have left one."""
        with self._using("read outcomes"):
            found = {node: read_outcome(self.store.run(name), job, attempt, node) for node in nodes}
            return {node: outcome for node, outcome in found.items() if outcome is not None}
        raise AssertionError

    def progress(self, name: str, epoch: int) -> Progress:
        """What the run holds after the attempt of this epoch."""
        with self._using(f"read the checkpoints of run {name}"):
            checkpoints = list_checkpoints(self.store.run(name))
            iteration = checkpoints[-1].iteration if checkpoints else None
            for checkpoint in reversed(checkpoints):
                if checkpoint.epoch == epoch:
                    with suppress(DamagedCheckpoint, KeyError, TypeError, ValueError):
                        return Progress(iteration, float(checkpoint.manifest["created"]))
            return Progress(iteration)
        raise AssertionError

    def release(self, name: str, epoch: int) -> None:
        """The attempt of this epoch is closed: while this controller lives, another one may then say that the run is written."""
        with suppress(OSError, DamagedFile):
            close_claim(self.store.run(name), epoch)

    @contextmanager
    def _using(self, what: str) -> Iterator[None]:
        path = self.store.path
        try:
            self._check()  # before a write, and after a read: what is missing may be missing because the volume is
            yield
            self._check()
        except (OSError, StaleEpoch) as error:
            raise StoreUnavailable(f"store {path}: can't {what} now ({error}); trying again") from error
        except (StoreError, ValueError) as error:
            raise RunRefused(f"store {path}: can't {what}: {error}") from error


class Errands:
    """Calls on the store for attempts: one at a time for each attempt, on a pool. The loop collects the results, and never waits."""

    def __init__(self, pool: Pool, store: str, changed: Callable[[str], None]) -> None:
        """``store``: its path, for messages; ``changed``: called, on any thread, with the job whose result is there."""
        self._pool, self._store, self._changed = pool, store, changed
        self._under_way: dict[Key, tuple[str, Future[Any], float]] = {}
        """By attempt: the name of its errand, the result, and since when it is under way (monotonic [s])."""
        self._failing = Backoff(log)

    def result(self, key: Key, name: str, body: Callable[[], T], again: bool = True) -> T | None:
        """The result of ``body``, once; None until it is there.

        Args:
            key: The attempt.
            name: Tells the errands of an attempt apart; another one that is under way is waited for, and its result dropped.
            body: The call.
            again: Call it again later where it raises StoreUnavailable.

        Raises:
            Exception: What else ``body`` raised.
        """
        under_way = self._under_way.get(key)
        if under_way is None:
            if not self._failing.waits(key):
                future = self._pool.submit(body)
                self._under_way[key] = name, future, machine.monotonic()
                future.add_done_callback(lambda _: self._changed(key[0]))
            return None
        started, future, _ = under_way
        if not future.done():
            return None
        del self._under_way[key]
        try:
            result: T = future.result()
        except StoreUnavailable as error:
            if not again:
                raise
            self._failing.failed(key, f"job {key[0]}: {error}")
            return None
        self._failing.worked(key)
        return result if started == name else self.result(key, name, body, again)

    def delayed(self, key: Key, more: str = "") -> Delayed | None:
        """That the store does not answer, or could not be used for the attempt the last time, as an event; ``more``: what else is amiss."""
        reason = "; ".join(each for each in (more, self._silence(key) or self.failure(key)) if each)
        return Delayed(reason) if reason else None

    def failure(self, key: Key) -> str:
        """Why the store could not be used for the attempt the last time; empty where it could."""
        return (self._failing.said(key) or "").removeprefix(f"job {key[0]}: ")

    def pause(self, key: Key) -> float:
        """Seconds until the store is tried again for the attempt, or is overdue; then infinity until it answers."""
        if key not in self._under_way:
            return self._failing.pause(key)
        left = self._under_way[key][2] + OVERDUE - machine.monotonic()
        return left if left > 0 else inf

    def _silence(self, key: Key) -> str:
        """That the store does not answer, and since when; empty while it does, or is not overdue."""
        since = self._under_way[key][2] if key in self._under_way else inf
        if (passed := machine.monotonic() - since) < OVERDUE:
            return ""
        began = datetime.fromtimestamp(machine.wall() - passed, UTC)
        return f"store {self._store} has not answered since {began:%Y-%m-%d %H:%M:%S} UTC"

    def forget(self, key: Key) -> None:
        """The attempt is closed."""
        self._under_way.pop(key, None)
        self._failing.worked(key)
