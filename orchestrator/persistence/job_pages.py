"""Pages of the list of jobs, the newest first, found by a key and not by a number: a page costs the same wherever it is."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self

from sqlalchemy import ColumnElement, Select, and_, or_, select, tuple_
from sqlalchemy.orm import Session, selectinload

from orchestrator.domain.errors import RequestError
from orchestrator.persistence.job_counts import Kind
from orchestrator.persistence.models import Job

_MOST_KINDS = 40
"""Kinds of jobs that are looked up one by one; where more are wanted, rows are passed over."""


@dataclass(frozen=True)
class Cursor:
    """The place of a job in the list."""

    created_at: int
    id: str

    @classmethod
    def of(cls, job: Job) -> Self:
        """The place of this job."""
        return cls(job.created_at, job.id)

    @classmethod
    def read(cls, text: str) -> Self:
        """What :meth:`__str__` has written. Raises RequestError."""
        created_at, _, job = text.partition("-")
        if not created_at.isdecimal() or len(created_at) > 15 or not job:
            raise RequestError(f"{text!r} is not a place in the list of jobs; leave it out for the newest")
        return cls(int(created_at), job)

    def __str__(self) -> str:
        return f"{self.created_at}-{self.id}"


@dataclass(frozen=True)
class Page:
    """Jobs of the list, the newest first."""

    jobs: Sequence[Job]
    is_first: bool
    """Whether there are no newer ones."""
    is_last: bool
    """Whether there are no older ones."""


def read_page(
    session: Session,
    conditions: Sequence[ColumnElement[bool]],
    kinds: Collection[Kind] | None,
    most: int,
    *,
    after: Cursor | None = None,
    before: Cursor | None = None,
) -> Page:
    """A page, with the attempts of its jobs.

    Args:
        session: Of the database.
        conditions: Of the jobs; arrays' children are left out.
        kinds: Queues and states of the jobs, without those that have none; None: of all.
        most: Jobs of the page.
        after: The page has the newest that are older than this place.
        before: It has the oldest that are newer than this place.
    """
    backwards = before is not None
    place = before or after
    start = [] if place is None else [_beyond(place, backwards)]
    base = select(Job).where(Job.parent.is_(None), *conditions, *start).limit(most + 1)
    if kinds is None:
        found = _ordered(session, base, backwards)
    elif len(kinds) > _MOST_KINDS:
        found = _ordered(session, base.where(tuple_(Job.queue, Job.status).in_(list(kinds))), backwards)
    else:  # each from its own part of an index, which has the jobs in order
        each = [
            _ordered(session, base.where(and_(Job.queue == queue, Job.status == status)), backwards)
            for queue, status in kinds
        ]
        merged = heapq.merge(*each, key=_place, reverse=not backwards)
        found = [job for job, _ in zip(merged, range(most + 1), strict=False)]
    more, jobs = len(found) > most, found[:most]
    if backwards:
        return Page(jobs[::-1], is_first=not more, is_last=False)
    return Page(jobs, is_first=after is None, is_last=not more)


def _ordered(session: Session, query: Select[Job], backwards: bool) -> Sequence[Job]:
    keys = (Job.created_at, Job.id) if backwards else (Job.created_at.desc(), Job.id.desc())
    return session.scalars(query.order_by(*keys).options(selectinload(Job.attempts))).all()


def _place(job: Job) -> tuple[int, str]:
    return job.created_at, job.id


def _beyond(place: Cursor, backwards: bool) -> ColumnElement[bool]:
    at, job = Job.created_at, Job.id
    if backwards:
        return and_(at >= place.created_at, or_(at > place.created_at, job > place.id))
    return and_(at <= place.created_at, or_(at < place.created_at, job < place.id))
