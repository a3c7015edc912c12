"""An overview of queues and compute: waiting jobs and their reasons, usage of shares, load of hosts, health of engines."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Query, Request
from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.control.compute_environments import own_queues
from orchestrator.control.controller import Controller
from orchestrator.control.snapshot import open_attempts, read_compute_environment, read_queue
from orchestrator.control.usage import held_by, placements_of, usage_at
from orchestrator.domain.hosts import Capacity, Queued, engine_of
from orchestrator.domain.job import Status
from orchestrator.domain.resources import Resources
from orchestrator.persistence.batch_models import Attempt, ComputeEnvironment, Job, JobQueue, SchedulingPolicy
from orchestrator.persistence.job_counts import JobCounts
from orchestrator.scheduling.order import score, weight
from orchestrator.scheduling.snapshot import Queue
from orchestrator.services.context import UnknownQueue
from orchestrator.services.permissions import Actor, JobsOf

router = APIRouter()

FIRST = 10
"""Waiting jobs of each queue that are reported, where none is named."""
MOST = 100
"""Of one that is named."""

Held = Sequence[tuple[Job, Attempt]]


@router.get("/queues")
def queues(
    request: Request,
    queue: str = Query(default="", max_length=128, description="this one alone, with more of its jobs"),
) -> dict[str, Any]:
    """The queues whose jobs the caller may see, each with the jobs that start next, and the compute environments, engines and hosts.

    How full a host is counts the jobs of all queues.
    """
    actor = actor_of(request)
    return overview(controller_of(request), actor, queue)


def overview(controller: Controller, actor: Actor, only: str = "") -> dict[str, Any]:
    """``queues``, ``computeEnvironments``, ``engines`` and ``hosts``; ``only``: name of the one queue that is wanted. Raises UnknownQueue."""
    engine = controller.engines
    capacities = engine.capacity()
    with controller.database.session() as session:
        policies = {policy.name: policy for policy in session.scalars(select(SchedulingPolicy))}
        rows = [
            row for row in session.scalars(select(JobQueue).order_by(JobQueue.name)) if actor.may_see(JobsOf(row.name))
        ]
        names = [row.name for row in rows]
        if only and only not in names:
            raise UnknownQueue(only, names, 404)
        rows = sorted((row for row in rows if only in ("", row.name)), key=lambda row: -row.priority)
        read = {row.name: read_queue(row, policies) for row in rows}
        held = open_attempts(session, controller.work_queue.active())
        decays = {name: queue.policy.decay_seconds for name, queue in read.items() if queue.policy}
        used = usage_at(session, controller.clock.now(), decays, held)
        counts = _counts(controller.database.counts)
        found = [
            {
                "name": row.name,
                "state": "DELETING" if row.deleting else row.state,
                "priority": row.priority,
                "policy": row.policy,
                "computeEnvironments": row.compute_environments,
                "counts": counts.get(row.name, {}),
                "inUse": _amounts(attempt for job, attempt in held if job.queue == row.name),
                "shares": _shares(read[row.name], used, held),
                "front": _front(controller, session, row.name, MOST if only else FIRST),
            }
            for row in rows
        ]
        compute_environments = [
            _compute_environment(row, engine.names[0]) for row in session.scalars(select(ComputeEnvironment))
        ]
        taken = _taken(held)
    return {
        "queues": found,
        "computeEnvironments": compute_environments,
        "engines": _engines(controller, capacities),
        "hosts": [
            {
                **{key: value for key, value in asdict(host).items() if key in ("name", "cpus", "memory")},
                "away": host.unavailable,
                "engine": engine_of(host.name),
                "gpus": len(host.gpus),
                "inUse": asdict(taken.get(host.name, Resources())),
            }
            for capacity in capacities.values()
            for host in capacity.machines
        ],
    }


def _counts(counts: JobCounts) -> dict[str, dict[str, int]]:
    """Jobs that are not over, by queue and state; an array is counted by its children."""
    found: dict[str, dict[str, int]] = defaultdict(dict)
    for (queue, status), count in counts.gangs().items():
        if not Status(status).is_terminal:
            found[queue][status] = count
    return found


def _front(controller: Controller, session: Session, queue: str, most: int) -> list[dict[str, Any]]:
    """The jobs of a queue that start next, in their order, with why each waits and since when [Unix ms]."""
    order, times = controller.admission.front(queue, most)
    jobs = {job.id: job for job in session.scalars(select(Job).where(Job.id.in_(order)))}
    waiting = [jobs[each] for each in order if each in jobs and jobs[each].status == Status.RUNNABLE]
    return [
        {
            "id": job.id,
            "name": job.name,
            "owner": job.owner,
            "share": job.share,
            "reason": controller.admission.reason(job).words,
            "since": times.get(job.id),
        }
        for job in waiting
    ]


def _shares(queue: Queue, used: Mapping[tuple[str, str], float], held: Held) -> list[dict[str, Any]]:
    """Each active share of a queue with a policy: its weight, its recent usage, and the resources that it holds; the least used come first.

    ``used``: GPU-seconds, or CPU-seconds of jobs without GPUs, decayed by the policy; ``score``: the same times the weight, by which
    shares are served.
    """
    if queue.policy is None:
        return []
    names = {share for name, share in used if name == queue.name}
    found = [
        {
            "share": share,
            "weight": weight(queue.policy, share),
            "used": used[queue.name, share],
            "score": score(queue, share, used),
            "inUse": _amounts(attempt for job, attempt in held if (job.queue, job.share or "") == (queue.name, share)),
        }
        for share in names
    ]
    return sorted(found, key=lambda each: (each["score"], each["share"]))


def _amounts(attempts: Iterable[Attempt]) -> dict[str, float]:
    held = sum((held_by(attempt) for attempt in attempts), Resources())
    return {"cpus": held.cpus, "gpus": held.gpus}


def _taken(held: Held) -> dict[str, Resources]:
    """The resources that the nodes of all gangs hold, by host."""
    found: dict[str, Resources] = defaultdict(Resources)
    for _, attempt in held:
        for each in placements_of(attempt):
            found[each.host] += each.resources
    return found


def _compute_environment(row: ComputeEnvironment, first: str) -> dict[str, Any]:
    read = read_compute_environment(row, first)
    return {"name": read.name, "engine": read.engine, "state": row.state, "hosts": read.hosts, "cpus": read.max_cpus}


def _engines(controller: Controller, capacities: Mapping[str, Capacity]) -> list[dict[str, Any]]:
    engine = controller.engines
    own = own_queues(engine.names)
    return [
        {
            "name": name,
            "queue": own[name],
            "elastic": engine.is_elastic([name]),
            "queuesByItself": isinstance(capacities.get(name), Queued),
            "toldAt": health.reported_at,
            "problem": health.problem,
            "failing": health.failing,
            "retry": health.retry,
        }
        for name, health in engine.health().items()
    ]
