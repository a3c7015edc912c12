"""From the database to a scheduling pass's snapshot, and what is known of the queues after the pass."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.accounting import usage_at
from orchestrator.clock import Clock
from orchestrator.definition import GangNeeds, gang_needs
from orchestrator.engines.base import Host, Placement, engine_of
from orchestrator.engines.several import Several
from orchestrator.pools import pool_engine
from orchestrator.scheduling import (
    FairShare,
    Fit,
    Leading,
    Pool,
    Queue,
    Running,
    Shape,
    Snapshot,
    TimeLimit,
    Waiting,
    fit,
)
from orchestrator.tables import Attempt, ComputeEnvironment, Job, JobQueue, SchedulingPolicy

HOSTS_TAG = "muster:hosts"
"""Tag that names the hosts of a compute environment, with commas between; all of its engine's without it."""
DEFAULT_DECAY = 600
"""``shareDecaySeconds`` where it is not set, or 0 (AWS's API model)."""


def take_snapshot(
    session: Session,
    clock: Clock,
    hosts: Sequence[Host],
    waiting: Sequence[Waiting],
    active: Sequence[str],
    leading: Mapping[str, Leading] | None = None,
    first: str = "local",
    queueing: Collection[str] = (),
) -> Snapshot:
    """Everything that the pass depends on, as it is now.

    Args:
        session: The session.
        clock: Tells what time it is.
        hosts: All that the engines have.
        waiting: The jobs that wait for room.
        active: Ids of the jobs that may hold some.
        leading: What the last pass found at the head of each queue.
        first: The controller's first engine.
        queueing: Engines that queue by themselves: what runs there takes nothing away from what is handed to them.
    """
    policies = {policy.name: policy for policy in session.scalars(select(SchedulingPolicy))}
    queues = {queue.name: read_queue(queue, policies) for queue in session.scalars(select(JobQueue))}
    pools = {each.name: read_pool(each, first) for each in session.scalars(select(ComputeEnvironment))}
    holding = open_attempts(session, active)
    counted = [(job, attempt) for job, attempt in holding if engine_of(attempt.nodes[0]["host"]) not in queueing]
    facts: dict[int, GangNeeds] = {}
    decays = {name: queue.policy.decay_seconds for name, queue in queues.items() if queue.policy}
    return Snapshot(
        now=clock.now(),
        drift=clock.drift,
        hosts=hosts,
        pools=pools,
        queues=queues,
        waiting=waiting,
        running=[_running(job, attempt, facts) for job, attempt in counted],
        usage=usage_at(session, clock.now(), decays, holding),
        leading=leading or {},
    )


def open_attempts(session: Session, jobs: Sequence[str]) -> list[tuple[Job, Attempt]]:
    """The jobs whose gang exists or may exist, with that attempt."""
    found = []
    for job_id in jobs:
        job = session.get(Job, job_id)
        # a damaged row has no nodes: what it holds is not known, and the controller says so of the job
        if job is not None and (attempt := job.open_attempt) is not None and attempt.nodes:
            found.append((job, attempt))
    return found


def fit_in_queue(session: Session, engine: Several, queue: JobQueue, shape: Shape, patience: float = 0.0) -> Fit:
    """What the queue would have for a gang if nothing ran; ``patience``: seconds to wait for the engines' newest hosts."""
    first = engine.names[0]
    rows = [row for name in queue.environments if (row := session.get(ComputeEnvironment, name)) is not None]
    pools = {row.name: read_pool(row, first) for row in rows}
    engines = dict.fromkeys(pool.engine for pool in pools.values() if pool.engine is not None)
    elastic = [name for name, pool in pools.items() if pool.engine is not None and engine.is_elastic([pool.engine])]
    return fit(shape, read_queue(queue, {}), pools, engine.capacity(engines, patience), elastic)


def read_queue(queue: JobQueue, policies: Mapping[str, SchedulingPolicy]) -> Queue:
    policy = policies.get(queue.policy) if queue.policy else None
    limits = tuple(TimeLimit(limit["reason"], limit["maxTimeSeconds"]) for limit in queue.limits)
    return Queue(
        queue.name, queue.priority, tuple(queue.environments), _fair_share(policy.fairshare) if policy else None, limits
    )


def _fair_share(document: Mapping[str, Any]) -> FairShare:
    weights = {
        each["shareIdentifier"]: each.get("weightFactor", 1.0) for each in document.get("shareDistribution") or []
    }
    decay = document.get("shareDecaySeconds") or DEFAULT_DECAY
    return FairShare(decay, document.get("computeReservation", 0), weights)


def read_pool(environment: ComputeEnvironment, first: str) -> Pool:
    """``first``: the engine of an environment that names none."""
    named = environment.tags.get(HOSTS_TAG)
    hosts = tuple(name.strip() for name in named.split(",")) if named else None
    most = (environment.document.get("computeResources") or {}).get("maxvCpus")
    cpus = float(most) if most is not None else None
    return Pool(environment.name, environment.state == "ENABLED", hosts, cpus, pool_engine(environment.tags, first))


def node_records(placements: Sequence[Placement]) -> list[dict[str, Any]]:
    """An attempt's nodes as its record has them before they run."""
    return [
        {"index": index, "host": each.host, "gpus": list(each.gpus), "cpus": each.cpus, "memory": each.memory}
        for index, each in enumerate(placements)
    ]


def placements_of(attempt: Attempt) -> tuple[Placement, ...]:
    return tuple(Placement(node["host"], tuple(node["gpus"]), node["cpus"], node["memory"]) for node in attempt.nodes)


def _running(job: Job, attempt: Attempt, facts: dict[int, GangNeeds]) -> Running:
    """``facts``: what was read already, by the definition's identity; the children of an array share one."""
    properties = job.node_properties
    needs = facts.get(id(properties))
    if needs is None and properties:  # empty where the row is damaged, which the controller says of the job
        needs = facts[id(properties)] = gang_needs(properties)
    return Running(
        job=job.id,
        name=job.name,
        queue=job.queue,
        share=job.share,
        priority=job.priority,
        pool=attempt.pool or "local",
        placements=placements_of(attempt),
        started_at=attempt.running_since,
        timeout=job.timeout,
        preemptible=needs is not None and needs.setting("MUSTER_PREEMPTIBLE") == "1",
        ending=attempt.ending is not None or job.stop_reason is not None,
    )
