"""The store as the controller's loop uses it: each call is carried out on a thread of a pool, since the volume may hang.

What is missing on a volume may be missing because the volume is: each answer counts only if the store is still the one that the
controller knows, after it was read.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, TypeVar

from orchestrator import machine
from orchestrator.control.peers import Peers
from orchestrator.domain.attempt_events import Delayed
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.machine import Pool
from shared_store.volume.checkpoints import DamagedCheckpoint, list_checkpoints
from shared_store.volume.epoch import Claim, StaleEpoch, close_claim, read_epoch, take_epoch
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run, Store, StoreError
from shared_store.volume.node_outcomes import Outcome, read_outcome
from shared_store.volume.texts import Reference, keep, read_either

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
class ObservedRun:
    """A run as it was found; a :class:`shared_store.volume.layout.Run` for those who only read its ``run.json``."""

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


def facts_of(run: Run) -> ObservedRun:
    """A run as the store has it now. Raises OSError."""
    try:
        content, damage = run.description(), ""
    except (ValueError, RecursionError) as error:
        content, damage = None, str(error)
    return ObservedRun(run.name, run.is_missing(), content, damage)


@dataclass(frozen=True)
class RunContent:
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

    def examine(self, name: str) -> ObservedRun:
        """A run before an attempt begins. Raises RunRefused."""

        def body() -> ObservedRun:
            run = self.store.run(name)
            return replace(facts_of(run), epoch=read_epoch(run), writer=self.peers.writer(run))

        return self._call(f"read run {name}", body)

    def claim(
        self,
        name: str,
        description: Mapping[str, Any],
        after: int,
        claim: Claim,
        texts: Sequence[tuple[Reference, Path]] = (),
    ) -> int:
        """Create the run, where it is missing, and give it to an attempt; returns the epoch, greater than ``after``.

        ``texts``: that the run gets a copy of, each with its folder. Raises RunRefused, also where one is missing or altered.
        """

        def body() -> int:
            run = self.store.run(name)
            found = [read_either(run.texts, source, reference) for reference, source in texts]
            run.create(dict(description))
            for text in found:
                keep(run.texts, text.encode())
            return take_epoch(run, after, claim)

        return self._call(f"prepare run {name}", body)

    def outcomes(self, name: str, job: str, attempt: int, nodes: Sequence[int]) -> Mapping[int, Outcome]:
        """The outcomes of those of these nodes that have left one."""

        def body() -> Mapping[int, Outcome]:
            found = {node: read_outcome(self.store.run(name), job, attempt, node) for node in nodes}
            return {node: outcome for node, outcome in found.items() if outcome is not None}

        return self._call("read outcomes", body)

    def progress(self, name: str, epoch: int) -> RunContent:
        """What the run holds after the attempt of this epoch."""

        def body() -> RunContent:
            checkpoints = list_checkpoints(self.store.run(name))
            iteration = checkpoints[-1].iteration if checkpoints else None
            for checkpoint in reversed(checkpoints):
                if checkpoint.epoch == epoch:
                    with suppress(DamagedCheckpoint, KeyError, TypeError, ValueError):
                        return RunContent(iteration, float(checkpoint.manifest["created"]))
            return RunContent(iteration)

        return self._call(f"read the checkpoints of run {name}", body)

    def release(self, name: str, epoch: int) -> None:
        """The attempt of this epoch is closed: while this controller lives, another one may then say that the run is written."""
        with suppress(OSError, DamagedFile):
            self._check()  # another volume may have a run of this name
            close_claim(self.store.run(name), epoch)

    def _call(self, what: str, body: Callable[[], T]) -> T:
        """The result of ``body``; ``what`` it does, for messages."""
        path = self.store.path
        try:
            self._check()  # before a write, and after a read: what is missing may be missing because the volume is
            result = body()
            self._check()
            return result
        except (OSError, StaleEpoch) as error:
            raise StoreUnavailable(f"store {path}: can't {what} now ({error}); trying again") from error
        except (StoreError, ValueError) as error:
            raise RunRefused(f"store {path}: can't {what}: {error}") from error


class Errands:
    """Calls on the store for attempts: one at a time for each attempt, on a pool. The loop collects the results, and never waits.

    Where an attempt is closed while its call hangs, the run's next attempt makes none until that one has returned: a bad directory holds
    one thread, and two claims of a run never overtake each other, of which the later one to land would fence off the other's gang.
    """

    def __init__(self, pool: Pool, store: str, changed: Callable[[str], None]) -> None:
        """``store``: its path, for messages; ``changed``: called, on any thread, with the job whose result is there."""
        self._pool, self._store, self._changed = pool, store, changed
        self._under_way: dict[Key, tuple[str, Future[Any], machine.Moment]] = {}
        """By attempt: the name of its errand, the result, and since when it is under way (monotonic [s])."""
        self._left: dict[str, Future[Any]] = {}
        """By run: the call of a closed attempt that had not returned."""
        self._failing = Backoff(log)

    def close(self) -> None:
        """Leave the calls that are under way to themselves."""
        self._pool.close()

    def await_earlier(self, run: str) -> None:
        """Raises StoreUnavailable while a call of an earlier attempt on the run has not returned."""
        if run in self._left and not self._left[run].done():
            raise StoreUnavailable(
                f"store {self._store}: can't read run {run} now (it has not answered the attempt before yet); trying again"
            )

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
                self._under_way[key] = name, future, machine.moment()
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
            self._failing.failed(key, str(error), of=f"job {key[0]}")
            return None
        self._failing.worked(key)
        return result if started == name else self.result(key, name, body, again)

    def trouble(self, key: Key) -> str:
        """That the store does not answer, or could not be used for the attempt the last time; empty where neither is so."""
        if key in self._under_way and (since := self._under_way[key][2]).passed >= OVERDUE:
            return f"store {self._store} has not answered since {since}"
        return self._failing.failure(key) or ""

    def delayed(self, key: Key) -> Delayed | None:
        """:meth:`trouble` as an event; None where there is none."""
        return Delayed(trouble) if (trouble := self.trouble(key)) else None

    def pause(self, key: Key) -> float:
        """Seconds until the store is tried again for the attempt, or is overdue; then infinity until it answers."""
        if key not in self._under_way:
            return self._failing.pause(key)
        left = OVERDUE - self._under_way[key][2].passed
        return left if left > 0 else inf

    def forget(self, key: Key, run: str, release: Callable[[int], None], epoch: int | None) -> None:
        """The attempt on a run is closed.

        Args:
            release: Called, on the pool, with the epoch that the attempt has, or gets by a claim that lands later.
            epoch: The attempt's; None where it has none yet.
        """
        self._failing.worked(key)
        name, call, _ = self._under_way.pop(key, ("", None, None))
        if call is not None:
            self._left = {each: left for each, left in self._left.items() if not left.done()} | {run: call}
        if epoch is not None:
            self._pool.submit(partial(release, epoch))
        elif call is not None and name == "claim":
            call.add_done_callback(lambda _: call.exception() or self._pool.submit(partial(release, call.result())))
