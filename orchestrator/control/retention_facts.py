"""What retention (:mod:`.retention`) reads: the facts about runs in the store and what in it needs them; its steps, and who requests them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator import machine
from orchestrator.control.peers import Peers
from orchestrator.domain.retention import Decision, References, RetentionReference, RunFacts
from orchestrator.persistence.keyset import Cursor
from shared_store.volume import contents, trash
from shared_store.volume.files import path_exists
from shared_store.volume.layout import Run, Store
from shared_store.volume.references import references


@dataclass(frozen=True)
class Requester:
    """Who requests a step or a deletion: nothing but what is theirs goes."""

    name: str
    queues: frozenset[str] | None = None
    """None: everything is theirs."""

    def owns(self, owner: str | None, queue: str) -> bool:
        """Whether a job or a run is theirs."""
        return self.queues is None or (owner == self.name and queue in self.queues)


CONTROLLER = Requester("this controller")


@dataclass(frozen=True)
class RetentionPlan:
    """What a step does, or would do, with a run and its jobs."""

    run: str
    decision: Decision
    facts: RunFacts | None
    """The run as it was; None where the store has no such run."""
    directories: tuple[Path, ...]
    """That go."""

    def described(self) -> dict[str, Any]:
        """For the API; sizes in bytes."""
        sizes = [trash.size_of(path) for path in self.directories]
        return {
            "run": self.run,
            "whole": self.decision.run,
            "jobs": list(self.decision.jobs),
            "bytes": sum(size for size, _ in sizes),
            "files": sum(count for _, count in sizes),
            "kept": list(self.decision.reasons),
        }


@dataclass
class PassTotals:
    """What a pass has taken."""

    jobs: int = 0
    runs: int = 0
    kept: int = 0
    bytes: int = 0

    def add(self, steps: Sequence[Mapping[str, Any]]) -> None:
        self.jobs += sum(len(each["jobs"]) for each in steps)
        self.runs += sum(each["whole"] for each in steps)
        self.bytes += sum(each["bytes"] for each in steps)
        self.kept += sum(bool(each["kept"]) for each in steps)

    def __str__(self) -> str:
        return f"{self.jobs} jobs and {self.runs} runs ({self.bytes / 2**20:.1f} MiB)"


Step = tuple[list[dict[str, Any]], Cursor | None]
"""What a step has found, as :meth:`RetentionPlan.described`, and where the next one begins."""


class StoredRuns:
    """Of one store. Any thread may call; all but :meth:`refresh` may wait for the store."""

    def __init__(self, store: Store, peers: Peers, check: Callable[[], None]) -> None:
        """
        Args:
            store: The shared volume.
            peers: The other controllers of the store.
            check: Raises Unavailable where the store is not there: what is missing may be missing for that.
        """
        self._store, self._peers, self.check = store, peers, check
        self._found: tuple[References, float, int] | None = None
        """The references, when they were looked for (monotonic [s]), and the version then."""
        self._version = 0
        self._scanning = threading.Lock()

    def facts(self, runs: Collection[str]) -> dict[str, RunFacts | None]:
        """Each run as the store has it now; None where there is none. Raises Unavailable."""
        self.check()
        found = {name: self._facts(self._store.run(name)) for name in runs}
        self.check()
        return found

    def is_unchanged(self, name: str, facts: RunFacts | None) -> bool:
        """Whether the run is as it was when :meth:`facts` answered."""
        return self._facts(self._store.run(name)) == facts

    def _facts(self, run: Run) -> RunFacts | None:
        try:
            inside = contents.contents(run)
            archived = contents.archived(run)
            writer = self._peers.writer(run)
        except FileNotFoundError as error:
            return RunFacts(run.name, damage=str(error)) if path_exists(run.path) else None
        except (OSError, ValueError) as error:  # which may be one of this run alone: the volume is checked afterwards
            return RunFacts(run.name, damage=str(error))
        by = None if archived is None else f"by {archived.get('by', 'an unknown key')}"
        return RunFacts(run.name, inside.epoch, inside.results, inside.logged, by, writer)

    def references(self, fresh: float) -> References:
        """What in the store needs runs, as it was at most so many seconds ago. Raises Unavailable."""
        with self._scanning:
            version, began = self._version, machine.monotonic()
            if self._found is None or began - self._found[1] > fresh or self._found[2] != version:
                self.check()
                needed, unreadable = references(self._store)
                self.check()
                found = References.of(
                    (RetentionReference(*each) for each in needed),
                    (each.why for each in unreadable if not each.whole),
                    (each.why for each in unreadable if each.whole),
                )
                self._found = found, began, version
            return self._found[0]

    def refresh(self) -> None:
        """Something in the store needs other runs than before. Waits for nothing."""
        self._version += 1
