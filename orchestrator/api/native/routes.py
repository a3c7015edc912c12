"""The native API: capacity, plans, jobs with all their attempts, logs as a stream; of runs, :mod:`orchestrator.api.native.run_routes`."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import asdict, replace
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.api import permissions
from orchestrator.api.batch import rules
from orchestrator.api.batch.operations import validate
from orchestrator.api.checkpoints import CONFLICT
from orchestrator.api.context import permitted_run, queue_names, reconciler_of
from orchestrator.api.damaged import reading
from orchestrator.api.errors import ClientError
from orchestrator.api.evaluated import check_evaluation
from orchestrator.api.http.following import Following, looked, looked_patiently, pause
from orchestrator.api.native import (
    job_list,
    key_routes,
    league_routes,
    model_routes,
    queue_overview,
    run_routes,
    runs,
    track_routes,
    webhook_routes,
)
from orchestrator.api.native.fitting import fit_of, named_queue
from orchestrator.api.permissions import JobsOf, Operation
from orchestrator.api.racing_tracks import check_tracks
from orchestrator.api.sources import sources_of
from orchestrator.control.bus import BusError
from orchestrator.control.compute_environments import own_queues, queue_engines
from orchestrator.control.reconciler import Reconciler
from orchestrator.control.snapshot import new_nodes
from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.hosts import Limit, Queued, engine_of
from orchestrator.domain.job import Status
from orchestrator.engines.api import EngineError, Gang, Plan
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.models import Attempt, Job
from orchestrator.persistence.ownership import is_of_earlier_run, owner_of
from orchestrator.persistence.queries import find_job, short_id
from orchestrator.persistence.session import DatabaseError
from orchestrator.scheduling.placement import needs
from shared_store.logs import LogFollower, LogLine, timestamp

router = APIRouter(prefix="/api")
router.include_router(job_list.router)
router.include_router(queue_overview.router)
router.include_router(run_routes.router)
router.include_router(model_routes.router)
router.include_router(league_routes.router)
router.include_router(track_routes.router)
router.include_router(webhook_routes.router)
router.include_router(key_routes.router)

_LARGEST_PLAN = 4 << 20
"""Characters of all nodes' variables together."""
_POLL = 0.05
"""Seconds between two looks at a log that is followed, while few are."""
_PATIENCE = 30.0
"""Seconds for which a log that is not followed may keep its reader waiting."""
_HEARTBEAT = 5.0
"""Seconds after which an idle stream sends an empty line, which is how a client that left is noticed."""


class PlanRequest(BaseModel):
    """A job that is not submitted."""

    definition: dict[str, Any] = Field(description="a RegisterJobDefinition request of type multinode")
    queue: str = "default"


def permitted_job(session: Session, reference: str, operation: Operation) -> Job:
    """The job, where the caller may do this to it. Raises ClientError."""
    job = find_job(session, reference, permissions.visible_queues())
    if job is None:
        hint = _jobs_of_run(session, reference) or f"job {reference} does not exist; `muster list` shows the jobs"
        raise ClientError(hint, 404)
    permissions.check(operation, job)
    return job


def _jobs_of_run(session: Session, reference: str) -> str:
    """A hint at the jobs that made the run of this name, for a caller who gives it in place of a job; empty without a visible job."""
    query = select(Job).where(Job.run == reference).order_by(Job.created_at)
    made = [job for job in session.scalars(query) if permissions.is_visible(job)]
    if not made:
        return ""
    named = ", ".join(f"{job.name} ({short_id(job.id)})" for job in made[-5:])
    which = "job" if len(made) == 1 else "jobs"
    return f"{reference} is a run, which {which} {named} made; see: muster show {short_id(made[-1].id)}"


@router.get("/capacity")
def capacity(request: Request, queue: str | None = None) -> dict[str, Any]:
    """The engines and their queues, their hosts with all that they have, and the store; of one queue, its hosts alone.

    ``queued``: the engines that queue and place gangs by themselves, each with the most that a gang may have there, or null where its
    hosts tell that.
    ``queues``: those whose jobs the caller may see.
    """
    reconciler = reconciler_of(request)
    names = reconciler.engine.names
    with reconciler.database.session() as session:
        if queue is not None:
            names = queue_engines(session, queue, names[0])
        queues = queue_names(session)
    capacities = reconciler.engine.capacity(names, FRESH)
    return {
        "engines": own_queues(reconciler.engine.names),
        "hosts": [asdict(host) for capacity in capacities.values() for host in capacity.machines],
        "queued": {name: _limit(each) for name, each in capacities.items() if isinstance(each, Queued)},
        "elastic": reconciler.engine.is_elastic(names),
        "store": str(reconciler.store.path),
        "queues": queues,
    }


def _limit(capacity: Queued) -> dict[str, Any] | None:
    limits = capacity.limits
    return {"queue": limits.queue, **asdict(limits.resources)} if isinstance(limits, Limit) else None


@router.post("/plan")
def plan(request: Request, body: PlanRequest) -> dict[str, Any]:
    """The processes that a job would start, and their hosts, if all hosts were free. Nothing is registered and nothing starts."""
    reconciler = reconciler_of(request)
    wanted, definition = _gang_of(body), body.definition
    check_tracks(reconciler.store, wanted.spec)
    for source in sources_of(wanted):
        run = permitted_run(reconciler, source.run, Operation.READ_RUN)
        if source.key in ("evaluate", "race"):
            check_evaluation(reconciler.store, run, wanted.spec or {}, source.key)
    with reconciler.database.session() as session:
        queue = named_queue(session, body.queue)
        permissions.check(Operation.PLAN, JobsOf(queue.name))
        found = fit_of(session, reconciler, queue, wanted, FRESH)
        if found.allocation is None:
            raise ClientError(
                found.problem or f"{needs(wanted.shape)}; no host that it could have is known now; more may come"
            )
        compute_environment, placements = found.allocation
        job = Job(
            id="job",
            name=definition["jobDefinitionName"],
            queue=queue.name,
            kind="multinode",
            run=wanted.options.run or "run",
            timeout=(definition.get("timeout") or {}).get("attemptDurationSeconds"),
            priority=definition.get("schedulingPriority", 0),
        )
        attempt = Attempt(number=1, epoch=1, compute_environment=compute_environment, nodes=new_nodes(placements))
        gang = reconciler.attempts.gang(session, job, attempt, wanted)  # neither of them is stored
    planned = _planned(reconciler, replace(gang, bus_token="…") if gang.bus_token else gang)
    nodes = [
        {
            "index": node.contract.node_index,
            "rank": node.contract.node_rank,
            "image": wanted.nodes[node.contract.node_index].container.get("image"),
            **asdict(node.placement),
            "address": node.contract.address,
            "command": list(node.command),
            "environment": {**node.environment, **node.contract.to_env()},
        }
        for node in planned.nodes
    ]
    size = sum(len(name) + len(value) for node in nodes for name, value in node["environment"].items())
    if size > _LARGEST_PLAN:
        raise ClientError(
            f"the plan's {len(nodes)} nodes have {size >> 20} MiB of variables, more than {_LARGEST_PLAN >> 20}; "
            "plan the job with fewer nodes"
        )
    name = engine_of(placements[0].host)
    images = reconciler.engine.engines[name].traits.images
    return {
        "engine": name,
        "computeEnvironment": compute_environment,
        "images": images,
        "nodes": nodes,
        "document": planned.document,
    }


@router.post("/fit")
def fits(request: Request, body: PlanRequest) -> dict[str, Any]:
    """Why the job could never start in the queue, whatever else ended; ``problem`` is null where it could."""
    reconciler = reconciler_of(request)
    wanted = _gang_of(body)
    check_tracks(reconciler.store, wanted.spec)
    with reconciler.database.session() as session:
        queue = named_queue(session, body.queue)
        permissions.check(Operation.FIT, JobsOf(queue.name))
        return {"problem": fit_of(session, reconciler, queue, wanted, FRESH).problem}


def _gang_of(body: PlanRequest) -> GangSpec:
    """The gang of a plan's job. Raises ClientError."""
    definition = validate("RegisterJobDefinition", body.definition)
    if definition["type"] != "multinode" or "nodeProperties" not in definition:
        raise ClientError("definition: a plan is made of a job of type multinode, with nodeProperties")
    return rules.check_nodes(rules.node_properties(definition), "multinode", complete=True)


def _planned(reconciler: Reconciler, gang: Gang) -> Plan[Any]:
    try:
        return reconciler.engine.plan(gang)
    except EngineError as error:
        raise ClientError(str(error)) from None


@router.get("/jobs/{reference}")
def job_detail(request: Request, reference: str) -> Any:
    """A job by id, by the start of its id, or by name (the newest): every attempt and node, its run and its results."""
    reconciler = reconciler_of(request)
    with reconciler.database.session() as session:
        job = permitted_job(session, reference, Operation.READ_JOB)
        run = reconciler.store.run(job.run)
        owner = owner_of(session, run)
        is_visible = owner is not None and permissions.is_visible(owner)  # a job may continue a run of another queue
        is_replaced = is_of_earlier_run(job, run)
        is_visible = is_visible and not is_replaced
        described = runs.results_of(reconciler, session, run) if is_visible else None
        with reading(job):
            attempts = [_attempt(reconciler, job, attempt.number) for attempt in job.attempts]
            gang = job.gang
            detail = {
                "id": job.id,
                "name": job.name,
                "owner": job.owner,
                "run": job.run,
                "runIsReplaced": is_replaced,
                "kind": job_list.kind_of(gang.spec),
                "status": job.status,
                "statusReason": reconciler.reason(job) or job.status_reason,
                "queue": job.queue,
                "share": job.share,
                "createdAt": job.created_at,
                "startedAt": job.started_at,
                "stoppedAt": job.stopped_at,
                "nodes": len(gang.nodes),
                "attempts": attempts,
                "attemptsAllowed": job.attempts_allowed,
                "spec": gang.spec,
                "results": described,
                "progress": runs.last_metrics(run) if is_visible else None,
            }
    return permissions.shown(detail)


@router.get("/jobs/{reference}/logs")
def job_logs(
    request: Request,
    reference: str,
    node: int | None = None,
    rank: int | None = None,
    attempt: int | None = None,
    follow: bool = False,
    positions: str = "{}",
) -> StreamingResponse:
    """The job's log lines as JSON lines, all nodes merged; with ``follow`` until the job is over.

    ``positions``: a JSON object of ``attempt/node`` and the ``position`` of its last line that the caller has.
    """
    reconciler = reconciler_of(request)
    with reconciler.database.session() as session:
        job = permitted_job(session, reference, Operation.READ_JOB_LOGS)
        with reading(job):
            count = len(job.gang.nodes)
        if node is not None and not 0 <= node < count:
            raise ClientError(
                f"job {job.name} ({job.id[:8]}) has nodes 0 to {count - 1}, none is {str(node)[:20]}", 404
            )
        follower = LogFollower(reconciler.store.run(job.run), job.id, node, rank, attempt, positions_of(positions))
        job_id = job.id
    lines = _follow(reconciler, job_id, follower, request.app.state.closing) if follow else _stored(follower)
    return Following(lines, media_type="application/x-ndjson")


def positions_of(text: str) -> dict[str, int]:
    """Raises ClientError."""
    try:
        given = json.loads(text)
        if all(isinstance(position, int) and 0 <= position < 2**63 for position in given.values()):
            return dict(given)
    except (ValueError, AttributeError, RecursionError):
        pass
    raise ClientError('positions: expected a JSON object such as {"1/0": 4096}')


@router.post("/jobs/{reference}/checkpoint")
def save_now(request: Request, reference: str) -> dict[str, str]:
    """Have a training job save now; answers when the checkpoint is durable."""
    reconciler = reconciler_of(request)
    job, attempt, nodes = _running(reconciler, reference, Operation.CHECKPOINT_JOB)
    return {"answer": _command(reconciler, job, attempt, nodes[0], "checkpoint", 150.0)}


@router.get("/jobs/{reference}/stacks")
def stacks(request: Request, reference: str) -> list[dict[str, Any]]:
    """The Python and native stacks of every rank, node by node."""
    reconciler = reconciler_of(request)
    job, attempt, nodes = _running(reconciler, reference, Operation.READ_JOB_STACKS)
    return [{"node": node, "stacks": _command(reconciler, job, attempt, node, "stacks", 60.0)} for node in nodes]


def _running(reconciler: Reconciler, reference: str, operation: Operation) -> tuple[str, int, list[int]]:
    """Id, attempt and nodes of a running job. Raises ClientError."""
    with reconciler.database.session() as session:
        job = permitted_job(session, reference, operation)
        attempt = job.open_attempt
        if job.status != Status.RUNNING or attempt is None:
            raise ClientError(f"job {job.name} ({job.id[:8]}) is {job.status}, not RUNNING", CONFLICT)
        with reading(job):
            main = job.gang.main
            nodes = sorted((node.index for node in attempt.nodes), key=lambda index: index != main)
        return job.id, attempt.number, nodes


def _command(reconciler: Reconciler, job: str, attempt: int, node: int, name: str, seconds: float) -> str:
    try:
        return reconciler.bus.command(job, attempt, node, name, seconds)
    except BusError as error:
        raise ClientError(str(error), 503) from None


def _attempt(reconciler: Reconciler, job: Job, number: int) -> dict[str, Any]:
    attempt = job.attempts[number - 1]
    run = reconciler.store.run(job.run)
    nodes = [
        {
            **node.shown(),
            "progress": reconciler.bus.progress(job.id, number, node.index),
            "running": attempt.stopped_at is None and node.exit_code is None,
            "log": str(run.log(job.id, number, node.index)),
        }
        for node in attempt.nodes
    ]
    return {
        "number": number,
        "epoch": attempt.epoch,
        "startedAt": attempt.started_at,
        "stoppedAt": attempt.stopped_at,
        "ending": attempt.ending,
        "exitCode": attempt.exit_code,
        "statusReason": attempt.status_reason,
        "spent": attempt.spent,
        "computeEnvironment": attempt.compute_environment,
        "gpuSeconds": attempt.gpu_seconds,
        "cpuSeconds": attempt.cpu_seconds,
        "wastedGpuSeconds": attempt.wasted_gpu_seconds,
        "wastedCpuSeconds": attempt.wasted_cpu_seconds,
        "nodes": nodes,
    }


async def _stored(follower: LogFollower) -> AsyncIterator[str]:
    """All that is there, many lines at a time: each piece costs a hand-over between threads."""
    batches = follower.batches()
    try:
        while (lines := await asyncio.wait_for(looked(lambda: next(batches, None)), _PATIENCE)) is not None:
            yield _json_lines(lines)
    except TimeoutError:
        yield _trouble(OSError(f"the store has not answered for {_PATIENCE:.0f} s"))
    except (OSError, ValueError) as error:
        yield _trouble(error)


def _trouble(error: Exception) -> str:
    """The last line of a stream that can't continue: of no node and no attempt."""
    text = f"the log can't be read now: {excerpt(' '.join(str(error).split()), LONGEST_REASON)}"
    return _json_lines([LogLine(timestamp(time.time()), 0, 0, None, "e", text)])


def _json_lines(lines: Sequence[LogLine]) -> str:
    return "".join([f"{line.to_json()}\n" for line in lines])


async def _follow(
    reconciler: Reconciler, job_id: str, follower: LogFollower, closing: threading.Event
) -> AsyncIterator[str]:
    """Lines as they come; a thread is taken only for each look, since many people may follow."""

    def look() -> tuple[str, bool]:
        with reconciler.database.session() as session:
            status = session.scalar(select(Job.status).where(Job.id == job_id))
        over = status is None or Status(status).is_terminal  # asked before the poll: nothing is written afterwards
        return _json_lines(follower.poll()), over

    spoken = time.monotonic()
    while not closing.is_set():
        lines, over = "", False
        try:
            async for found in looked_patiently(look, _HEARTBEAT):
                if found is None:
                    yield "\n"
                else:
                    lines, over = found
        except (OSError, ValueError, DatabaseError) as error:
            yield _trouble(error)
            return
        if lines:
            yield lines
            spoken = time.monotonic()
        if over:
            async for lines in _stored(follower):
                yield lines
            return
        if time.monotonic() - spoken > _HEARTBEAT:
            yield "\n"
            spoken = time.monotonic()
        if not follower.behind:
            await asyncio.sleep(pause(_POLL))
