"""The snapshot of a scheduling pass, read from the database, and the facts about queues after the pass."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from orchestrator.control.clock import Clock
from orchestrator.control.compute_environments import engine_named_by, environments_of
from orchestrator.control.usage import placements_of, usage_at
from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Capacity, Host, Placement, Queued, engine_of
from orchestrator.domain.native_options import NativeOptions
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence import batch_models
from orchestrator.persistence.batch_models import Attempt, Job, JobQueue, Node, SchedulingPolicy
from orchestrator.scheduling.fit import Fit, fit
from orchestrator.scheduling.snapshot import (
    ComputeEnvironment,
    FairShare,
    Leading,
    Queue,
    RoundRobin,
    RunningGang,
    Snapshot,
    TimeLimit,
    Waiting,
)

HOSTS_TAG = "muster:hosts"
"""Tag that names the hosts of a compute environment, with commas between; all of its engine's without it."""
DEFAULT_DECAY = 600
"""``shareDecaySeconds`` where it is not set, or 0 (AWS's API model)."""
_LOADED_AT_ONCE = 500


def take_snapshot(
    session: Session,
    clock: Clock,
    capacities: Mapping[str, Capacity],
    waiting: Sequence[Waiting],
    holding: Sequence[tuple[Job, Attempt]],
    leading: Mapping[str, Leading],
    turns: RoundRobin,
    first: str = "local",
    unknown: Mapping[str, str] | None = None,
) -> Snapshot:
    """Read everything that the pass depends on.

    Args:
        session, clock: The database, and steady time.
        capacities: All that the engines have, by their names.
        waiting: The jobs that wait for room.
        holding: The jobs whose gang holds some, with that attempt.
        leading: The job that the last pass found at the head of each queue.
        turns: As the last pass has left them.
        first: The controller's first engine.
        unknown: Why an engine has not reported what it has, by name; read before ``capacities``, which count.
    """
    unknown = {name: why for name, why in (unknown or {}).items() if name not in capacities}
    anew = {"populate_existing": True}  # a session of the loop may have rows that requests have changed since
    policies = {each.name: each for each in session.scalars(select(SchedulingPolicy), execution_options=anew)}
    queues = {
        each.name: read_queue(each, policies) for each in session.scalars(select(JobQueue), execution_options=anew)
    }
    ces = {
        each.name: read_compute_environment(each, first, unknown)
        for each in session.scalars(select(batch_models.ComputeEnvironment), execution_options=anew)
    }
    # what runs on an engine that queues by itself takes nothing away from what is handed to it
    queueing = {name for name, capacity in capacities.items() if isinstance(capacity, Queued)}
    counted = [(job, attempt) for job, attempt in holding if engine_of(attempt.nodes[0].host) not in queueing]
    decays = {name: queue.policy.decay_seconds for name, queue in queues.items() if queue.policy}
    return Snapshot(
        now=clock.now(),
        drift=clock.drift,
        hosts=_places(capacities),
        compute_environments=ces,
        queues=queues,
        waiting=waiting,
        running=[_running(job, attempt) for job, attempt in counted],
        usage=usage_at(session, clock.now(), decays, holding),
        leading=leading,
        turns=turns,
    )


def open_attempts(session: Session, jobs: Sequence[str]) -> list[tuple[Job, Attempt]]:
    """The jobs whose gang exists or may exist, with that attempt."""
    known: dict[str, Job] = {}
    for start in range(0, len(jobs), _LOADED_AT_ONCE):
        some = select(Job).where(Job.id.in_(jobs[start : start + _LOADED_AT_ONCE])).options(selectinload(Job.attempts))
        known |= {job.id: job for job in session.scalars(some)}
    return holding_of(known[job_id] for job_id in jobs if job_id in known)


def holding_of(jobs: Iterable[Job]) -> list[tuple[Job, Attempt]]:
    """Those of these jobs whose gang exists or may exist, with that attempt."""
    # a damaged row has no nodes: what it holds is not known, and the controller says so of the job
    return [(job, attempt) for job in jobs if (attempt := job.open_attempt) is not None and attempt.nodes]


def fit_in_queue(session: Session, engine: EngineSet, queue: JobQueue, shape: Shape) -> Fit:
    """The hosts for a gang in the queue if nothing else ran, or why it could never start."""
    first = engine.names[0]
    rows = environments_of(session, queue)
    engines = dict.fromkeys(engine_named_by(row.tags, first) for row in rows)
    before = engine.unknown()
    capacities = engine.capacity(engines)
    unknown = {name: why for name, why in before.items() if name not in capacities}
    ces = {row.name: read_compute_environment(row, first, unknown) for row in rows}
    elastic = [name for name, ce in ces.items() if ce.engine is not None and engine.is_elastic([ce.engine])]
    return fit(shape, read_queue(queue, {}), ces, _places(capacities), elastic)


def _places(capacities: Mapping[str, Capacity]) -> Sequence[Host]:
    return [host for capacity in capacities.values() for host in capacity.places]


def read_queue(queue: JobQueue, policies: Mapping[str, SchedulingPolicy]) -> Queue:
    policy = policies.get(queue.policy) if queue.policy else None
    limits = tuple(TimeLimit(limit["reason"], limit["maxTimeSeconds"]) for limit in queue.limits)
    return Queue(
        queue.name,
        queue.priority,
        tuple(queue.compute_environments),
        _fair_share(policy.fairshare) if policy else None,
        limits,
    )


def _fair_share(document: Mapping[str, Any]) -> FairShare:
    weights = {
        each["shareIdentifier"]: each.get("weightFactor", 1.0) for each in document.get("shareDistribution") or []
    }
    decay = document.get("shareDecaySeconds") or DEFAULT_DECAY
    return FairShare(decay, document.get("computeReservation", 0), weights)


def read_compute_environment(
    row: batch_models.ComputeEnvironment, first: str, unknown: Mapping[str, str] | None = None
) -> ComputeEnvironment:
    """``first``: the engine of one that names none. ``unknown``: why an engine has not reported what it has, by the names of those."""
    named = row.tags.get(HOSTS_TAG)
    hosts = tuple(name.strip() for name in named.split(",")) if named else None
    most = (row.document.get("computeResources") or {}).get("maxvCpus")
    cpus = float(most) if most is not None else None
    engine = engine_named_by(row.tags, first)
    return ComputeEnvironment(row.name, row.state == "ENABLED", hosts, cpus, engine, (unknown or {}).get(engine, ""))


def new_nodes(placements: Sequence[Placement]) -> list[Node]:
    """An attempt's nodes as they are recorded before they run."""
    return [
        Node(index=index, host=each.host, gpus=each.gpus, cpus=each.cpus, memory=each.memory)
        for index, each in enumerate(placements)
    ]


def _running(job: Job, attempt: Attempt) -> RunningGang:
    try:
        options = job.gang.options
    except Exception:  # a damaged row, which is reported when the job is settled
        options = NativeOptions()
    return RunningGang(
        job=job.id,
        name=job.name,
        queue=job.queue,
        share=job.share,
        priority=job.priority,
        compute_environment=attempt.environment,
        placements=placements_of(attempt),
        started_at=attempt.running_since,
        timeout=job.timeout,
        preemptible=options.preemptible,
        ending=attempt.ending is not None or job.stop_reason is not None,
    )
