"""The log streams: one for every node of every attempt of every job."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import or_, select
from sqlalchemy.orm import Session, joinedload, load_only, raiseload

from orchestrator.api import permissions
from orchestrator.api.batch.describe import stream_name
from orchestrator.api.logs.events import LogFile, log_file
from orchestrator.api.permissions import Operation
from orchestrator.persistence.models import Attempt, Job, Node
from shared_store.layout import Store

MOST_STREAMS = 1000
"""A request that names no stream is about this many: those of the newest jobs that it can be about."""
_NAME = re.compile(r"[^/:*]+/([0-9A-Za-z.-]{1,128})/([1-9][0-9]{0,5})/node-(0|[1-9][0-9]{0,5})")


@dataclass(frozen=True)
class Stream:
    """The log of one node in one attempt."""

    name: str
    path: Path
    """The file; it appears with the node's first line."""
    created: int
    """Unix time [ms]."""
    live: bool
    """Whether more lines can come; asked before the file is looked at, so that False means: all is there."""

    @property
    def file(self) -> LogFile:
        return log_file(self.path, self.name)


def find_stream(session: Session, store: Store, name: str, operation: Operation) -> Stream | None:
    """The stream of that name; None where no such job, attempt or node exists. Raises Refusal where it is not the caller's."""
    match = _NAME.fullmatch(name)
    job = session.get(Job, match[1].replace(".", ":")) if match else None
    attempt = session.get(Attempt, (job.id, int(match[2]))) if match and job else None
    if not job or not attempt:
        return None
    permissions.check(operation, job)
    return next((stream for stream in _streams(store, job, attempt) if stream.name == name), None)


def newest_streams(session: Session, store: Store, prefix: str = "", since: int = 0) -> list[Stream]:
    """Up to MOST_STREAMS streams whose names begin with ``prefix``, of the newest jobs that the caller may see.

    Args:
        session: On the database.
        store: The store that holds the files.
        prefix: Of the names; empty for all.
        since: Attempts that ended before this Unix time [ms] are left out.
    """
    query = (
        select(Attempt, Job)
        .join(Job, Attempt.job_id == Job.id)
        .options(
            raiseload(Job.array),
            load_only(Job.name, Job.run),
            load_only(Attempt.created_at, Attempt.stopped_at),
            joinedload(Attempt.nodes).load_only(Node.index),
        )
        .where(or_(Attempt.stopped_at.is_(None), Attempt.stopped_at >= since))
        .order_by(Attempt.stopped_at.is_(None).desc(), Job.created_at.desc(), Job.id, Attempt.number)
        .limit(MOST_STREAMS)
    )
    if (queues := permissions.visible_queues()) is not None:
        query = query.where(Job.queue.in_(queues))
    name, slash, rest = prefix.partition("/")
    if slash:
        query = query.where(
            Job.name == name, Job.id.startswith(rest.partition("/")[0].replace(".", ":"), autoescape=True)
        )
    elif prefix:
        query = query.where(Job.name.startswith(prefix, autoescape=True))
    found = [stream for attempt, job in session.execute(query).unique() for stream in _streams(store, job, attempt)]
    return [stream for stream in found if stream.name.startswith(prefix)][:MOST_STREAMS]


def _streams(store: Store, job: Job, attempt: Attempt) -> Iterator[Stream]:
    run, live = store.run(job.run), attempt.stopped_at is None
    for node in attempt.nodes:
        name = stream_name(job, attempt.number, node.index)
        yield Stream(name, run.log(job.id, attempt.number, node.index), attempt.created_at, live)
