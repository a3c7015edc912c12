"""How many jobs there are, by queue and state: kept in memory, so that no list counts rows."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from sqlalchemy import func, select
from sqlalchemy.orm import Session, attributes

from orchestrator.domain.job import Status
from orchestrator.persistence.models import Job

Kind = tuple[str, str]
"""A queue and a state."""


class JobCounts:
    """Of one database; children of arrays are not counted. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = Counter[Kind]()

    def load(self, session: Session) -> None:
        """Count the rows."""
        grouped = select(Job.queue, Job.status, func.count()).where(Job.parent.is_(None))
        found = session.execute(grouped.group_by(Job.queue, Job.status))
        counts = Counter({(queue, str(status)): int(count) for queue, status, count in found})
        with self._lock:
            self._counts = counts

    def add(self, changes: Mapping[Kind, int]) -> None:
        """A transaction has made these changes."""
        with self._lock:
            for kind, change in changes.items():
                self._counts[kind] += change
                if not self._counts[kind]:
                    del self._counts[kind]

    def of(self, queues: Collection[str] | None = None) -> dict[Kind, int]:
        """The counts of these queues, or of all; kinds of which there is no job are left out."""
        with self._lock:
            return {kind: count for kind, count in self._counts.items() if queues is None or kind[0] in queues}


def note_counts(session: Session, changed: Iterable[object]) -> None:
    """Note, before a flush, what its new, ``changed`` and deleted objects change of the counts, for :meth:`JobCounts.add` after the commit."""
    changes = session.info.setdefault("counts", Counter())
    for each in session.new:
        if isinstance(each, Job) and each.parent is None:
            changes[each.queue, str(each.status or Status.SUBMITTED)] += 1
    for each in changed:
        if isinstance(each, Job):
            before = attributes.instance_state(each).committed_state.get("status")
            if before is not None and before != each.status and each.parent is None:
                changes[each.queue, str(before)] -= 1
                changes[each.queue, str(each.status)] += 1
    for each in session.deleted:
        if isinstance(each, Job) and each.parent is None:
            changes[each.queue, str(each.status)] -= 1


def note_deleted(session: Session, jobs: Iterable[tuple[str | None, str, str]]) -> None:
    """The same for rows that a statement deletes: of each the parent, the queue and the state."""
    changes = session.info.setdefault("counts", Counter())
    for parent, queue, status in jobs:
        if parent is None:
            changes[queue, str(status)] -= 1
