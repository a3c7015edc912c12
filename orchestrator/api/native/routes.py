"""The native API: capacity, plans, jobs with all their attempts, logs as a stream; of runs, :mod:`orchestrator.api.native.run_routes`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import StreamingResponse
from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.api.batch.fargate import without_effect
from orchestrator.api.http.answer_streams import PIECE, Following
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native import (
    job_list,
    key_routes,
    model_routes,
    plan_routes,
    queue_overview,
    retention_routes,
    run_routes,
    submit_routes,
    webhook_routes,
)
from orchestrator.api.native.log_stream import followed, positions_of, stored
from orchestrator.control.bus import BusError
from orchestrator.control.compute_environments import own_queues, queue_engines
from orchestrator.control.controller import Controller
from orchestrator.control.run_store import facts_of
from orchestrator.control.store_calls import StoreSilent
from orchestrator.domain.errors import ClientError
from orchestrator.domain.hosts import Limit, Queued
from orchestrator.domain.job import Status
from orchestrator.domain.reasons import named, short_id
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.ownership import is_of_earlier_run, owner_of
from orchestrator.persistence.queries import find_job, unknown_job
from orchestrator.services import runs
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.context import named_definition, queue_names
from orchestrator.services.damaged_rows import reading
from orchestrator.services.permissions import Actor, Operation
from shared_store.contract.phases import count_in, phase_in
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run
from shared_store.volume.log_view import Chosen, LogView

router = APIRouter(prefix="/api")
router.include_router(job_list.router)
router.include_router(queue_overview.router)
router.include_router(run_routes.router)
router.include_router(retention_routes.router)
router.include_router(submit_routes.texts)
router.include_router(model_routes.router)
router.include_router(webhook_routes.router)
router.include_router(key_routes.router)
router.include_router(plan_routes.router)
router.include_router(submit_routes.router)


def permitted_job(session: Session, actor: Actor, reference: str, operation: Operation) -> Job:
    """The job, where the caller may do this to it. Raises ClientError."""
    who = actor.queues, actor.name
    job = find_job(session, reference, *who)
    if job is None:
        raise ClientError(_jobs_of_run(session, actor, reference) or unknown_job(session, reference, *who), 404)
    actor.check(operation, job)
    return job


def _jobs_of_run(session: Session, actor: Actor, reference: str) -> str:
    """A hint at the jobs that made the run of this name, for a caller who gives it in place of a job; empty without a visible job."""
    query = select(Job).where(Job.run == reference).order_by(Job.created_at)
    made = [job for job in session.scalars(query) if actor.may_see(job)]
    if not made:
        return ""
    names = ", ".join(named(job.name, job.id) for job in made[-5:])
    which = "job" if len(made) == 1 else "jobs"
    return f"{reference} is a run (created by {which} {names}); try: muster show {short_id(made[-1].id)}"


@router.get("/capacity")
def capacity(request: Request, queue: str | None = None) -> dict[str, Any]:
    """The engines and their queues, their hosts with all that they have, and the store; of one queue, its hosts alone.

    ``queued``: the engines that queue and place gangs by themselves, each with the most that a gang may have there, or null where its
    hosts tell that.
    ``queues``: those whose jobs the caller may see.
    """
    controller, actor = controller_of(request), actor_of(request)
    names = controller.engines.names
    with controller.database.session() as session:
        if queue is not None:
            names = queue_engines(session, queue, names[0])
        queues = queue_names(session, actor)
    capacities = controller.engines.capacity(names, FRESH)
    return {
        "engines": own_queues(controller.engines.names),
        "hosts": [asdict(host) for capacity in capacities.values() for host in capacity.machines],
        "queued": {name: _limit(each) for name, each in capacities.items() if isinstance(each, Queued)},
        "elastic": controller.engines.is_elastic(names),
        "store": str(controller.access.store.path),
        "queues": queues,
    }


def _limit(capacity: Queued) -> dict[str, Any] | None:
    limits = capacity.limits
    return {"queue": limits.queue, **asdict(limits.resources)} if isinstance(limits, Limit) else None


@router.get("/jobs/{reference}")
def job_detail(
    request: Request,
    reference: str,
    store: Annotated[bool, Query(description="whether to read the run in the store: its results and progress")] = True,
) -> Any:
    """A job by id, by the start of its id, or by name (the newest of the caller, else of all): every attempt and node, its run and its results.

    ``awsCode``: what the AWS Batch API states beyond ``statusReason``: AWS's code, or AWS's own words. ``ranSeconds``: how long all
    attempts ran, together. ``phase``: what a training does at present;
    ``phase_count``: how far that is, such as ``37/120`` kernels. ``children``: of an array, those that failed first.
    ``storeProblem``: why there are no results, where the store does not answer. ``runIsGone``: it was deleted;
    ``runIsReplaced``: another run has its name now.
    ``isOwn``: the caller has submitted it. ``withoutEffect``: members of its definition for Fargate, which change nothing here.
    """
    controller, actor = controller_of(request), actor_of(request)
    with controller.database.session() as session:
        job = permitted_job(session, actor, reference, Operation.READ_JOB)
        run = controller.access.store.run(job.run)
    problem, is_replaced, is_gone, results, progress = None, False, False, None, None
    try:
        found = controller.access.calls.call(partial(facts_of, run)) if store else None
        if found is not None:
            with controller.database.session() as session:
                owner = owner_of(session, found)
            is_replaced = is_of_earlier_run(job, found)
            is_gone = found.missing and job.first_epoch is not None and job.stopped_at is not None
            # a job may continue a run of another queue
            if owner is not None and actor.may_see(owner) and not is_replaced:
                results, progress = controller.access.calls.call(partial(_results, run))
    except (StoreSilent, OSError) as error:
        problem = str(error)
    with controller.database.session() as session:
        job = permitted_job(session, actor, job.id, Operation.READ_JOB)
        described = runs.described(session, actor, results) if results else None
        definition = named_definition(session, job.definition)
        with reading(job):
            attempts = [_attempt(controller, job, attempt.number) for attempt in job.attempts]
            gang, reason = job.gang, job_list.reason_of(controller, session, job)
            doing = _doing(attempts, gang.main) if job.status == Status.RUNNING else None
            detail = {
                "id": job.id,
                "name": job.name,
                "owner": job.owner,
                "isOwn": job.owner == actor.name,
                "run": job.run,
                "runIsReplaced": is_replaced,
                "runIsGone": is_gone,
                "kind": job_list.kind_of(gang.spec),
                "status": job.status,
                "statusReason": reason.words or None,
                "awsCode": reason.code or None,
                "queue": job.queue,
                "share": job.share,
                "createdAt": job.created_at,
                "startedAt": job.started_at,
                "stoppedAt": job.stopped_at,
                **job_list.ran(job.run_time),
                "phase": phase_in(doing),
                "phase_count": count_in(doing),
                "children": job_list.children_of(controller, session, job) if job.kind == "array" else None,
                "nodes": len(gang.nodes),
                "attempts": attempts,
                "attemptsAllowed": job.attempts_allowed,
                "withoutEffect": without_effect(
                    definition.document if definition else {}, [node.container for node in gang.nodes]
                ),
                "spec": gang.spec,
                "results": described,
                "progress": progress,
                "storeProblem": problem,
            }
    return actor.shown(detail)


def _doing(attempts: Sequence[dict[str, Any]], main: int) -> dict[str, Any] | None:
    """What the main node of the newest attempt reported last."""
    nodes = attempts[-1]["nodes"] if attempts else []
    return next((node["progress"] for node in nodes if node["index"] == main), None)


def _results(run: Run) -> tuple[runs.StoredRun | None, dict[str, Any] | None]:
    """What the store has of a run, and its newest metrics; a damaged run must not take the job away."""
    try:
        stored = runs.stored_run(run)
    except (DamagedFile, OSError):
        return None, runs.last_metrics(run)
    return stored if stored.found.content else None, runs.last_metrics(run)


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
    controller, actor = controller_of(request), actor_of(request)
    with controller.database.session() as session:
        job = permitted_job(session, actor, reference, Operation.READ_JOB_LOGS)
        with reading(job):
            count = len(job.gang.nodes)
        if node is not None and not 0 <= node < count:
            raise ClientError(
                f"job {named(job.name, job.id)} has no node {str(node)[:20]}: it is out of range (0-{count - 1})", 404
            )
        chosen = Chosen(controller.access.store.run(job.run), job.id, node, rank, attempt)
    view, calls = LogView(chosen, positions_of(positions), PIECE), controller.access.followed
    lines = followed(view, controller.logs, calls, request.app.state.closing) if follow else stored(view, calls)
    return Following(lines, media_type="application/x-ndjson")


@router.post("/jobs/{reference}/checkpoint")
def save_now(request: Request, reference: str) -> dict[str, str]:
    """Have a training job save now; answers when the checkpoint is durable."""
    controller, actor = controller_of(request), actor_of(request)
    job, attempt, nodes = _running(controller, actor, reference, Operation.CHECKPOINT_JOB)
    return {"answer": _command(controller, job, attempt, nodes[0], "checkpoint", 150.0)}


@router.get("/jobs/{reference}/stacks")
def stacks(request: Request, reference: str) -> list[dict[str, Any]]:
    """The Python and native stacks of every rank, node by node."""
    controller, actor = controller_of(request), actor_of(request)
    job, attempt, nodes = _running(controller, actor, reference, Operation.READ_JOB_STACKS)
    return [{"node": node, "stacks": _command(controller, job, attempt, node, "stacks", 60.0)} for node in nodes]


def _running(controller: Controller, actor: Actor, reference: str, operation: Operation) -> tuple[str, int, list[int]]:
    """Id, attempt and nodes of a running job. Raises ClientError."""
    with controller.database.session() as session:
        job = permitted_job(session, actor, reference, operation)
        attempt = job.open_attempt
        if job.status != Status.RUNNING or attempt is None:
            raise ClientError(f"job {named(job.name, job.id)} is {job.status}, not RUNNING", CONFLICT)
        with reading(job):
            main = job.gang.main
            nodes = sorted((node.index for node in attempt.nodes), key=lambda index: index != main)
        return job.id, attempt.number, nodes


def _command(controller: Controller, job: str, attempt: int, node: int, name: str, seconds: float) -> str:
    try:
        return controller.bus.command(job, attempt, node, name, seconds)
    except BusError as error:
        raise ClientError(str(error), 503) from None


def _attempt(controller: Controller, job: Job, number: int) -> dict[str, Any]:
    attempt = job.attempts[number - 1]
    run = controller.access.store.run(job.run)
    nodes = [
        {
            **node.shown(),
            "progress": controller.bus.progress(job.id, number, node.index),
            "running": attempt.stopped_at is None and node.exit_code is None,
            "log": str(run.log(job.id, number, node.index)) if attempt.epoch else None,
        }
        for node in attempt.nodes
    ]
    return {
        "number": number,
        "epoch": attempt.epoch,
        "startedAt": attempt.started_at,
        "stoppedAt": attempt.stopped_at,
        **job_list.ran(attempt.run_time),
        "ending": attempt.ending,
        "exitCode": attempt.exit_code,
        "statusReason": attempt.status_reason and attempt.in_own_words(attempt.status_reason),
        "fault": attempt.fault,
        "spent": attempt.spent,
        "computeEnvironment": attempt.compute_environment,
        "gpuSeconds": attempt.gpu_seconds,
        "cpuSeconds": attempt.cpu_seconds,
        "wastedGpuSeconds": attempt.wasted_gpu_seconds,
        "wastedCpuSeconds": attempt.wasted_cpu_seconds,
        "nodes": nodes,
    }
