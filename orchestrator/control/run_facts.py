"""The facts about runs in the store, and what in it needs them, as retention asks (:mod:`.retention`)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from orchestrator import machine
from orchestrator.control.peers import Peers
from orchestrator.domain.retention import References, RetentionReference, RunFacts
from shared_store.volume import contents
from shared_store.volume.files import is_there
from shared_store.volume.layout import Run, Store
from shared_store.volume.references import references


@dataclass(frozen=True)
class _Found:
    references: References
    found_at: float
    """Monotonic [s], before it was looked for."""
    version: int
    """:attr:`StoredRuns._version` then."""


class StoredRuns:
    """Of one store. Any thread may call; all but :meth:`look_again` may wait for the store."""

    def __init__(self, store: Store, peers: Peers, check: Callable[[], None]) -> None:
        """
        Args:
            store: The shared volume.
            peers: The other controllers of the store.
            check: Raises Unavailable where the store is not there: what is missing may be missing for that.
        """
        self._store, self._peers, self.check = store, peers, check
        self._found: _Found | None = None
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
            return RunFacts(run.name, damage=str(error)) if is_there(run.path) else None
        except (OSError, ValueError) as error:  # which may be one of this run alone: the volume is checked afterwards
            return RunFacts(run.name, damage=str(error))
        return RunFacts(run.name, inside.epoch, inside.results, inside.logged, _by_whom(archived), writer)

    def references(self, fresh: float) -> References:
        """What in the store needs runs, as it was at most so many seconds ago. Raises Unavailable."""
        with self._scanning:
            found, version, began = self._found, self._version, machine.monotonic()
            if found is None or began - found.found_at > fresh or found.version != version:
                self.check()
                needed, unreadable = references(self._store)
                self.check()
                found = _Found(
                    References.of(
                        (RetentionReference(*each) for each in needed),
                        (each.why for each in unreadable if not each.whole),
                        (each.why for each in unreadable if each.whole),
                    ),
                    began,
                    version,
                )
                self._found = found
            return found.references

    def look_again(self) -> None:
        """Something in the store needs other runs than before. Waits for nothing."""
        self._version += 1


def _by_whom(archived: Mapping[str, Any] | None) -> str | None:
    return None if archived is None else f"by {archived.get('by', 'an unknown key')}"
