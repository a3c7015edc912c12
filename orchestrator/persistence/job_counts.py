"""How many jobs there are, by queue and state: kept in memory, so that no list, page or metric counts rows."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from enum import Enum

from sqlalchemy import func, select
from sqlalchemy.orm import Session, attributes

from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Job


class ArrayRole(Enum):
    """Where a job stands."""

    ALONE = "alone"
    ARRAY = "array"
    CHILD = "child"

    @classmethod
    def of(cls, parent: str | None, kind: str | None) -> ArrayRole:
        return cls.CHILD if parent is not None else cls.ARRAY if kind == "array" else cls.ALONE


Kind = tuple[str, str, ArrayRole]
"""A queue, a state and a place."""


class JobCounts:
    """Of one database. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = Counter[Kind]()

    def load(self, session: Session) -> None:
        """Count the rows."""
        kinds = (Job.queue, Job.status, Job.parent.is_(None), Job.kind == "array")
        found = session.execute(select(*kinds, func.count()).group_by(*kinds))
        counts = Counter[Kind]()
        for queue, status, is_top, is_array, count in found:
            place = ArrayRole.CHILD if not is_top else ArrayRole.ARRAY if is_array else ArrayRole.ALONE
            counts[queue, str(status), place] += int(count)
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
        """The jobs of these queues, or of all, in each state, an array as one; states of none are left out."""
        found = Counter[str]()
        for (queue, status, place), count in self._kinds():
            if place is not ArrayRole.CHILD and (queues is None or queue in queues):
                found[status] += count
        return dict(found)

    def gangs(self) -> dict[tuple[str, str], int]:
        """The jobs of each queue in each state, an array as its children."""
        found = Counter[tuple[str, str]]()
        for (queue, status, place), count in self._kinds():
            if place is not ArrayRole.ARRAY:
                found[queue, status] += count
        return dict(found)

    def _kinds(self) -> list[tuple[Kind, int]]:
        with self._lock:
            return list(self._counts.items())


def note_counts(session: Session, changed: Iterable[object]) -> None:
    """Note, before a flush, what its new, ``changed`` and deleted objects change of the counts, for :meth:`JobCounts.add` after the commit."""
    changes = _changes(session)
    for each in session.new:
        if isinstance(each, Job):
            changes[each.queue, str(each.status or Status.SUBMITTED), ArrayRole.of(each.parent, each.kind)] += 1
    for each in changed:
        if isinstance(each, Job) and (before := _stored(each)) != each.status:
            place = ArrayRole.of(each.parent, each.kind)
            changes[each.queue, before, place] -= 1
            changes[each.queue, str(each.status), place] += 1
    for each in session.deleted:
        if isinstance(each, Job):
            changes[each.queue, _stored(each), ArrayRole.of(each.parent, each.kind)] -= 1


def note_rows(session: Session, queue: str, status: str, place: ArrayRole, change: int) -> None:
    """The same for rows that a statement inserts, or deletes (``change`` < 0)."""
    _changes(session)[queue, str(status), place] += change


def _changes(session: Session) -> Counter[Kind]:
    changes: Counter[Kind] = session.info.setdefault("counts", Counter())
    return changes


def _stored(job: Job) -> str:
    """The state that its row has; the column keeps it where it is replaced (``active_history``)."""
    return str(attributes.instance_state(job).committed_state.get("status", job.status))
