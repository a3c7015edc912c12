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

    def by_status(self, queues: Collection[str] | None = None) -> dict[str, int]:
        """The jobs of these queues, or of all, in each state; states of none are left out."""
        found = Counter[str]()
        with self._lock:
            for (queue, status), count in self._counts.items():
                if queues is None or queue in queues:
                    found[status] += count
        return dict(found)


def note_counts(session: Session, changed: Iterable[object]) -> None:
    """Note, before a flush, what its new, ``changed`` and deleted objects change of the counts, for :meth:`JobCounts.add` after the commit."""
    changes = _changes(session)
    for each in session.new:
        if isinstance(each, Job) and each.parent is None:
            changes[each.queue, str(each.status or Status.SUBMITTED)] += 1
    for each in changed:
        if isinstance(each, Job) and (before := _stored(each)) != each.status and each.parent is None:
            changes[each.queue, before] -= 1
            changes[each.queue, str(each.status)] += 1
    for each in session.deleted:
        if isinstance(each, Job) and each.parent is None:
            changes[each.queue, _stored(each)] -= 1


def note_deleted(session: Session, jobs: Iterable[tuple[str | None, str, str]]) -> None:
    """The same for rows that a statement deletes: of each the parent, the queue and the state."""
    changes = _changes(session)
    for parent, queue, status in jobs:
        if parent is None:
            changes[queue, str(status)] -= 1


def _changes(session: Session) -> Counter[Kind]:
    changes: Counter[Kind] = session.info.setdefault("counts", Counter())
    return changes


def _stored(job: Job) -> str:
    """The state that its row has; the column keeps it where it is replaced (``active_history``)."""
    return str(attributes.instance_state(job).committed_state.get("status", job.status))
