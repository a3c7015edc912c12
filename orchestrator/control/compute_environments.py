"""The built-in queues and compute environments: one of each for every engine.

A job goes to an engine by its queue. The queue ``default`` is that of the first engine, unless it was given others, or has jobs of another
engine that have not ended.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from orchestrator.domain.job import TERMINAL
from orchestrator.engines.installed import ENGINES
from orchestrator.persistence.batch_models import ComputeEnvironment, Job, JobQueue
from shared_store.contract.error_text import counted

log = logging.getLogger("muster.controller")

ENGINE_TAG = "muster:engine"
"""Tag that names the engine of a compute environment; without it, the controller's first engine."""


def in_order(session: Session, engines: Sequence[str]) -> list[str]:
    """``engines``, first the one that has the queue ``default``: their order moves no job to another engine, and says so."""
    first, default = engines[0], session.get(JobQueue, "default")
    before = (
        default.compute_environments[0] if default is not None and len(default.compute_environments) == 1 else first
    )
    if before == first or before not in ENGINES:
        return list(engines)
    # a compute environment that names no engine goes with the queue
    unnamed = {each.name for each in session.scalars(select(ComputeEnvironment)) if ENGINE_TAG not in each.tags}
    queues = [each.name for each in session.scalars(select(JobQueue)) if unnamed & set(each.compute_environments)]
    moved = select(func.count()).where(Job.queue.in_([*queues, "default"]), Job.status.not_in(TERMINAL))
    if not (count := session.scalar(moved)):
        return list(engines)
    jobs = f"{counted(count, 'job')} in it {'has' if count == 1 else 'have'} not ended"
    if before not in engines:
        log.warning("queue default moves from engine %s, which is not served, to engine %s: %s", before, first, jobs)
        return list(engines)
    log.warning("queue default stays with engine %s: %s; engine %s has a queue of its name", before, jobs, first)
    return [before, *(each for each in engines if each != before)]


def ensure_compute_environments(session: Session, engines: Sequence[str]) -> None:
    """A compute environment for each of ``engines``, and a queue of its name for each but the first, which has ``default``."""
    for name, queue in own_queues(engines).items():
        if (compute_environment := session.get(ComputeEnvironment, name)) is None:
            compute_environment = ComputeEnvironment(name=name, document={}, tags={})
            session.add(compute_environment)
        compute_environment.document = {**compute_environment.document, "type": "MANAGED"}
        if compute_environment.tags.get(ENGINE_TAG) != name:
            compute_environment.tags = {**compute_environment.tags, ENGINE_TAG: name}
        if queue != "default" and session.get(JobQueue, queue) is None:
            session.add(JobQueue(name=queue, compute_environments=[name]))
    default = session.get(JobQueue, "default")
    if default is not None and len(default.compute_environments) == 1 and default.compute_environments[0] in ENGINES:
        default.sent_order = default.sent_order if default.compute_environments == [engines[0]] else None
        default.compute_environments = [engines[0]]


def is_built_in(compute_environment: ComputeEnvironment) -> bool:
    """Whether this is an engine's built-in compute environment."""
    return compute_environment.name in ENGINES and compute_environment.tags.get(ENGINE_TAG) == compute_environment.name


def own_queues(engines: Sequence[str]) -> dict[str, str]:
    """The built-in queue of each engine: ``default`` for the first."""
    return {name: name if number else "default" for number, name in enumerate(engines)}


def queue_engines(session: Session, queue: str, first: str) -> list[str]:
    """The engines of a queue's compute environments, in their order; none for a queue that does not exist."""
    found = session.get(JobQueue, queue)
    rows = environments_of(session, found) if found else []
    return list(dict.fromkeys(engine_named_by(each.tags, first) for each in rows))


def environments_of(session: Session, queue: JobQueue) -> list[ComputeEnvironment]:
    """The compute environments of a queue, in their order."""
    found = (session.get(ComputeEnvironment, name) for name in queue.compute_environments)
    return [each for each in found if each is not None]


def engine_named_by(tags: dict[str, str], first: str) -> str:
    """The engine of a compute environment with these tags."""
    return tags.get(ENGINE_TAG, first)


def options_of(compute_environment: ComputeEnvironment | None, queue: JobQueue | None) -> dict[str, str]:
    """Options for an engine: ``muster:NAME=VALUE`` tags of a compute environment, and over them those of a queue."""
    found = (compute_environment, queue)
    tags = {name: value for each in found if each is not None for name, value in each.tags.items()}
    return {name.removeprefix("muster:"): value for name, value in tags.items() if name.startswith("muster:")}
