"""Pages of the list of jobs, the newest first, found by a place and not by a number: a page costs the same wherever it is."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select, union_all
from sqlalchemy.orm import Session, defer, selectinload

from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.keyset import Cursor, behind

_KEYS = (Job.created_at, Job.id)
_MOST_PARTS = 100
"""Parts of the list that are read one by one; where there are more, all jobs are looked through."""


def place_of(job: Job) -> Cursor:
    """The place of a job in the list."""
    return Cursor(job.created_at, job.id)


@dataclass(frozen=True)
class JobPage:
    """Jobs of the list, the newest first."""

    jobs: Sequence[Job]
    is_first: bool
    """Whether there are no newer ones."""
    is_last: bool
    """Whether there are no older ones."""


def read_page(
    session: Session,
    most: int,
    queues: Collection[str] | None = None,
    statuses: Collection[str] = (),
    conditions: Sequence[ColumnElement[bool]] = (),
    *,
    after: Cursor | None = None,
    before: Cursor | None = None,
) -> JobPage:
    """A page, with the attempts of its jobs, without their requests.

    Args:
        session: Of the database.
        most: Jobs of the page.
        queues: Of the jobs; None: of all.
        statuses: Of the jobs; empty: of all.
        conditions: Of the jobs, besides. Jobs that do not meet them are passed over one by one.
        after: The page has the newest jobs that are older than this place.
        before: The page has the oldest jobs that are newer than this place; only one of both may be set.
    """
    backwards = before is not None
    query = select(*_KEYS).where(Job.parent.is_(None), *conditions)
    if (place := before or after) is not None:
        query = query.where(behind(_KEYS, (place.at, place.id), (not backwards,) * 2))
    query = query.order_by(*_order(Job, backwards)).limit(most + 1)
    parts = [select(query.where(*part).subquery()) for part in _parts(queues, statuses)]
    if not parts:
        return JobPage([], is_first=True, is_last=True)
    found = union_all(*parts).subquery()
    ids = select(found.c.id).order_by(*_order(found.c, backwards)).limit(most + 1)
    # one statement: a job that changes its state meanwhile is neither found twice nor missed
    whole = select(Job).where(Job.id.in_(ids)).order_by(*_order(Job, backwards))
    read = session.scalars(whole.options(selectinload(Job.attempts), defer(Job.request))).all()
    has_more, jobs = len(read) > most, read[:most]
    if backwards:
        return JobPage(jobs[::-1], is_first=not has_more, is_last=False)
    return JobPage(jobs, is_first=after is None, is_last=not has_more)


def contains(session: Session, text: str) -> ColumnElement[bool]:
    """Whether a job's name, run or owner has this text, or its id begins with it; upper and lower case are the same."""
    columns = (Job.name, Job.run, Job.owner)
    if session.get_bind().dialect.name == "sqlite":  # its LIKE heeds no case, and its lower() costs more than all else
        places = [each.contains(text, autoescape=True) for each in columns]
        return or_(*places, Job.id.startswith(text, autoescape=True))
    places = [each.icontains(text, autoescape=True) for each in columns]
    return or_(*places, Job.id.istartswith(text, autoescape=True))


def count(
    session: Session, queues: Collection[str] | None, conditions: Sequence[ColumnElement[bool]], most: int
) -> Mapping[str, int]:
    """The jobs of these queues that meet the conditions, by state; at most so many are counted, the newest."""
    query = select(Job.id).where(Job.parent.is_(None), *conditions)
    if queues is not None:
        query = query.where(Job.queue.in_(queues))
    ids = query.order_by(*_order(Job, False)).limit(most)
    grouped = select(Job.status, func.count()).where(Job.id.in_(ids)).group_by(Job.status)
    return {str(status): int(number) for status, number in session.execute(grouped)}


def _parts(queues: Collection[str] | None, statuses: Collection[str]) -> Sequence[Sequence[ColumnElement[bool]]]:
    """Conditions of the parts of the list, each of which is in order in an index; no job is in two of them."""
    of_queue = [[]] if queues is None else [[Job.queue == queue] for queue in set(queues)]
    of_status = [[Job.status == status] for status in set(statuses)] or [[]]
    if len(of_queue) * len(of_status) > _MOST_PARTS:
        return [[Job.queue.in_(queues or ()), *([Job.status.in_(statuses)] if statuses else [])]]
    return [[*queue, *status] for queue, status in product(of_queue, of_status)]


def _order(columns: Any, backwards: bool) -> Sequence[ColumnElement[Any]]:
    keys = columns.created_at, columns.id
    return keys if backwards else tuple(key.desc() for key in keys)
