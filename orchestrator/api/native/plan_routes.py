"""The native API's routes for plans: the processes that a job would start, and whether it could ever start."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from orchestrator.api.batch import validation
from orchestrator.api.batch.operations import validate
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.control.compute_environments import options_of
from orchestrator.control.controller import Controller
from orchestrator.control.snapshot import new_nodes
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.hosts import engine_of
from orchestrator.engines.api import EngineError, Gang, Plan
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.batch_models import Attempt, ComputeEnvironment, Job
from orchestrator.scheduling.placement import needs
from orchestrator.services.chosen_checkpoints import check_evaluation, check_task, check_training
from orchestrator.services.context import permitted_run
from orchestrator.services.fit import fit_of, named_queue
from orchestrator.services.permissions import JobsOf, Operation
from orchestrator.services.sources import sources_of
from shared_store.contract import plugins

router = APIRouter(route_class=StoreRoute)

_LARGEST_PLAN = 4 << 20
"""Characters of all nodes' variables together."""


class PlanRequest(BaseModel):
    """A job that is not submitted."""

    definition: dict[str, Any] = Field(description="a RegisterJobDefinition request of type multinode")
    queue: str = "default"


@router.post("/plan")
def plan(request: Request, body: PlanRequest) -> dict[str, Any]:
    """The processes that a job would start, and their hosts, if all hosts were free. Nothing is registered and nothing starts."""
    controller, actor = controller_of(request), actor_of(request)
    requested, definition = _gang_of(body), body.definition
    check_training(controller.access.store, requested.spec)
    for source in sources_of(requested):
        run = permitted_run(controller, actor, source.run, Operation.READ_RUN)
        if not source.is_teacher:
            check_task(run)
        if source.key in plugins.evaluating():
            check_evaluation(controller.access.store, run, requested.spec or {}, source.key)
    controller.engines.capacity(patience=FRESH)  # before the transaction, which must not wait for an engine
    with controller.database.session() as session:
        queue = named_queue(session, actor, body.queue)
        actor.check(Operation.PLAN, JobsOf(queue.name))
        found = fit_of(session, actor, controller, queue, requested)
        if found.allocation is None:
            raise ClientError(
                found.problem or f"{needs(requested.shape)}; no matching host is registered; the engine may add hosts"
            )
        compute_environment, placements = found.allocation
        job = Job(
            id="job",
            name=definition["jobDefinitionName"],
            queue=queue.name,
            kind="multinode",
            run=requested.options.run or "run",
            timeout=(definition.get("timeout") or {}).get("attemptDurationSeconds"),
            priority=definition.get("schedulingPriority", 0),
        )
        attempt = Attempt(number=1, epoch=1, compute_environment=compute_environment, nodes=new_nodes(placements))
        options = options_of(session.get(ComputeEnvironment, compute_environment), queue)
        gang = controller.attempts.gang(job, attempt, requested, options)  # neither of the two is stored
    planned = _planned(controller, replace(gang, bus_token="…") if gang.bus_token else gang)
    nodes = [
        {
            "index": node.contract.node_index,
            "rank": node.contract.node_rank,
            "image": requested.nodes[node.contract.node_index].container.get("image"),
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
    images = controller.engines.engines[name].traits.images
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
    controller, actor = controller_of(request), actor_of(request)
    requested = _gang_of(body)
    check_training(controller.access.store, requested.spec)
    controller.engines.capacity(patience=FRESH)
    with controller.database.session() as session:
        queue = named_queue(session, actor, body.queue)
        actor.check(Operation.FIT, JobsOf(queue.name))
        return {"problem": fit_of(session, actor, controller, queue, requested).problem}


def _gang_of(body: PlanRequest) -> GangSpec:
    """The gang of a plan's job. Raises ClientError."""
    definition = validate("RegisterJobDefinition", body.definition)
    if definition["type"] != "multinode" or "nodeProperties" not in definition:
        raise ClientError("definition: a plan is made of a job of type multinode, with nodeProperties")
    return validation.check_nodes(validation.node_properties(definition), "multinode")


def _planned(controller: Controller, gang: Gang) -> Plan[Any]:
    try:
        return controller.engines.plan(gang)
    except EngineError as error:
        raise ClientError(str(error)) from None
