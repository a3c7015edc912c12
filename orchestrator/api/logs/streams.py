"""The log streams: one for every node of every attempt of every job, and the empty ones that clients have created."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import String, and_, func, literal, or_, select
from sqlalchemy.orm import Session, joinedload, load_only, raiseload

from orchestrator.api.batch.descriptions import stream_name
from orchestrator.api.logs.log_events import LogFile, log_file
from orchestrator.domain.gang import LOG_GROUP
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.own_models import LogStream
from orchestrator.services.permissions import Actor, Operation
from shared_store.volume.layout import Run, Store

MOST_STREAMS = 1000
"""A request that names no stream is about this many: those of the newest jobs that it can be about."""
_NAME = re.compile(r"[^:*]+/([0-9A-Za-z.-]{1,128})/([1-9][0-9]{0,5})/node-(0|[1-9][0-9]{0,5})")
_NO_FILE = Path(os.devnull, "none")
"""Of the streams that clients have created: nothing is ever written there."""


@dataclass(frozen=True)
class Stream:
    """The log of one node in one attempt."""

    name: str
    group: str
    """Name of its log group."""
    path: Path
    """The file; it appears with the node's first line."""
    created: int
    """Unix time [ms]."""
    live: bool = False
    """Whether more lines can come; asked before the file is looked at, so that False means: all is there."""
    run: Run | None = None
    job: str = ""
    attempt: int = 0
    node: int = 0
    """Whose log it is; of a stream that a client has created, nobody's."""

    @property
    def file(self) -> LogFile:
        return log_file(self.path, self.name)


def find_stream(
    session: Session, actor: Actor, store: Store, group: str, name: str, operation: Operation
) -> Stream | None:
    """The stream of that name in a group; None where none exists. Raises Refusal where it is not the caller's."""
    if (row := session.get(LogStream, (group, name))) is not None:
        return Stream(name, group, _NO_FILE, row.created_at)
    match = _NAME.fullmatch(name)
    job = session.get(Job, match[1].replace(".", ":")) if match else None
    attempt = session.get(Attempt, (job.id, int(match[2]))) if match and job else None
    if not job or not attempt:
        return None
    found = next((stream for stream in _streams(store, job, attempt, {group}) if stream.name == name), None)
    if found is not None:
        actor.check(operation, job)
    return found


def newest_streams(
    session: Session,
    actor: Actor,
    store: Store,
    groups: Collection[str] = (LOG_GROUP,),
    prefix: str = "",
    since: int = 0,
) -> list[Stream]:
    """Up to MOST_STREAMS streams of jobs, of the newest jobs that the caller may see.

    Args:
        groups: Names of the log groups.
        prefix: Of the names of the streams; empty for all.
        since: Attempts that ended before this Unix time [ms] are left out.
    """
    in_group = Node.log_group.in_([group for group in groups if group != LOG_GROUP])
    conditions = [or_(in_group, Node.log_group.is_(None)) if LOG_GROUP in groups else in_group]
    if prefix:  # a whole name begins with the prefix, or the prefix with that of a job's names
        beginning = func.coalesce(Node.log_prefix, Job.name) + "/" + func.replace(Job.id, ":", ".") + "/"
        text = literal(prefix, String)
        conditions.append(
            or_(
                func.substr(beginning, 1, len(prefix)) == text,
                func.substr(text, 1, func.length(beginning)) == beginning,
            )
        )
    query = (
        select(Attempt, Job)
        .join(Job, Attempt.job_id == Job.id)
        .options(
            raiseload(Job.array),
            load_only(Job.name, Job.run),
            load_only(Attempt.created_at, Attempt.stopped_at),
            joinedload(Attempt.nodes).load_only(Node.index, Node.log_group, Node.log_prefix),
        )
        .where(or_(Attempt.stopped_at.is_(None), Attempt.stopped_at >= since), Attempt.nodes.any(and_(*conditions)))
        .order_by(Attempt.stopped_at.is_(None).desc(), Job.created_at.desc(), Job.id, Attempt.number)
        .limit(MOST_STREAMS)
    )
    if (queues := actor.queues) is not None:
        query = query.where(Job.queue.in_(queues))
    rows = session.execute(query).unique()
    found = [stream for attempt, job in rows for stream in _streams(store, job, attempt, groups)]
    return [stream for stream in found if stream.name.startswith(prefix)][:MOST_STREAMS]


def created_streams(session: Session, group: str, prefix: str) -> list[Stream]:
    """The streams of a group that clients have created, whose names begin with ``prefix``."""
    rows = session.scalars(select(LogStream).where(LogStream.log_group == group))
    return [Stream(row.name, group, _NO_FILE, row.created_at) for row in rows if row.name.startswith(prefix)]


def _streams(store: Store, job: Job, attempt: Attempt, groups: Collection[str]) -> Iterator[Stream]:
    run, live = store.run(job.run), attempt.stopped_at is None
    for node in attempt.nodes:
        group = LOG_GROUP if node.log_group is None else node.log_group
        if group in groups:
            name = stream_name(job, attempt.number, node.index, node.log_prefix)
            path, log = run.log(job.id, attempt.number, node.index), (job.id, attempt.number, node.index)
            yield Stream(name, group, path, attempt.created_at, live, run, *log)
