"""The native API's routes for runs: read their description, checkpoints and metrics; resume one, clone one."""

from __future__ import annotations

from typing import Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import IdempotencyKey, actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.services import clone as clones
from orchestrator.services import runs
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Operation
from orchestrator.services.resume import resume
from orchestrator.services.spec_submission import Changes
from shared_store.volume.checkpoints import best_checkpoint, list_checkpoints
from shared_store.volume.evaluations import by_checkpoint, list_evaluations
from shared_store.volume.metrics import history_of

router = APIRouter(route_class=StoreRoute)

RUNS_A_PAGE = 100
METRICS_A_PAGE = 10_000


class _ChangesRequest(BaseModel):
    nodes: int | None = Field(
        default=None, ge=1, description="another number of nodes; the worlds are distributed anew"
    )
    set: list[str] = Field(default_factory=list, description="key.path=value changes of the spec")
    directory: str = Field(default="", description="working directory of the job")
    checkpoint: int | Literal["best", "latest"] | None = None

    def changes(self) -> Changes:
        return Changes(self.checkpoint, tuple(self.set), self.directory, self.nodes)


class ResumeRequest(_ChangesRequest):
    """Changes of a resumed run."""

    checkpoint: int | None = Field(default=None, description="iteration; the newest where absent")
    dry_run: bool = Field(default=False, description="check it, and answer the definition that would be registered")


class CloneRequest(_ChangesRequest):
    """The new run's name, the checkpoint of its weights, and its changes."""

    name: str = Field(max_length=128, description="of the new run, and of its job")
    checkpoint: int | Literal["best", "latest"] | None = Field(
        default=None, description="iteration; best: by evaluations, else by score; latest, or absent: the newest"
    )
    dry_run: bool = Field(default=False, description="check it, and answer the definition that would be registered")


@router.get("/runs")
def list_runs(
    request: Request,
    response: Response,
    after: str = Query(default="", max_length=128, description="name of the last run of the page before"),
    most: int = Query(default=RUNS_A_PAGE, ge=1, le=RUNS_A_PAGE, alias="max"),
    search: str = Query(default="", max_length=128, description="part of a name"),
    archived: bool = Query(default=False, description="those that are archived, in place of the others"),
) -> Any:
    """The runs of the store that the caller may see, by name, a page at a time; the header ``Link`` (``rel="next"``) has the address of the next page."""
    controller, actor = controller_of(request), actor_of(request)
    found = runs.list_runs(controller, actor, after, most, search, archived)
    if len(found) == most:
        filters = {**({"search": search} if search else {}), **({"archived": "true"} if archived else {})}
        query = urlencode({"max": most, "after": found[-1]["run"], **filters})
        response.headers["Link"] = f'</api/runs?{query}>; rel="next"'
    return actor.shown(found)


@router.get("/runs/{name}")
def run_detail(request: Request, name: str) -> Any:
    """One run; ``parent`` is where its weights come from, ``clones`` are the runs that began with its own."""
    controller, actor = controller_of(request), actor_of(request)
    run = permitted_run(controller, actor, name, Operation.READ_RUN)
    described = runs.describe_run(controller, actor, run)
    return actor.shown({**described, "clones": runs.clones_of(controller, actor, run)})


@router.get("/runs/{name}/checkpoints")
def run_checkpoints(request: Request, name: str, verify: bool = False) -> list[dict[str, Any]]:
    """The run's committed checkpoints, the newest last; with ``verify`` their digests are checked."""
    run = permitted_run(controller_of(request), actor_of(request), name, Operation.READ_CHECKPOINTS)
    evaluated, best = by_checkpoint(run), best_checkpoint(run)
    return [
        {
            **runs.describe_checkpoint(checkpoint, verify),
            "evaluated": _evaluated(evaluated.get(checkpoint.name)),
            "best": best is not None and best.name == checkpoint.name,
        }
        for checkpoint in list_checkpoints(run)
    ]


def _evaluated(summary: dict[str, Any] | None) -> dict[str, Any] | None:
    """The result of a checkpoint in the worlds of its training: ``mean``, ``low``, ``high`` of the return, ``episodes``."""
    if summary is None:
        return None
    returned = summary.get("return")
    interval = returned if isinstance(returned, dict) else {}
    ends = {end: interval.get(end) for end in ("low", "high")}
    return {"mean": summary["mean_return"], **ends, "episodes": summary["episodes"], "name": summary["name"]}


@router.get("/runs/{name}/evaluations")
def run_evaluations(request: Request, name: str) -> list[dict[str, Any]]:
    """The summaries of the run's evaluations, the newest last; ``table`` names the Parquet file beside each in ``evaluations/``."""
    return list_evaluations(permitted_run(controller_of(request), actor_of(request), name, Operation.READ_EVALUATIONS))


@router.get("/runs/{name}/metrics")
def run_metrics(
    request: Request,
    response: Response,
    name: str,
    after: int = 0,
    most: int = Query(default=METRICS_A_PAGE, ge=1, le=METRICS_A_PAGE, alias="max"),
) -> list[dict[str, Any]]:
    """The run's metrics, one record an iteration, for the first ``max`` iterations greater than ``after``; the header ``Link`` (``rel="next"``) has the address of the next page."""
    history = history_of(permitted_run(controller_of(request), actor_of(request), name, Operation.READ_METRICS))
    found = history.after(after, most)
    if len(found) == most or history.behind:
        last = found[-1]["iteration"] if found else after
        response.headers["Link"] = f'</api/runs/{name}/metrics?max={most}&after={last}>; rel="next"'
    return found


@router.post("/runs/{name}/resume")
def resume_run(
    request: Request, name: str, body: ResumeRequest, idempotency_key: IdempotencyKey = None
) -> dict[str, Any]:
    """Submit a job that continues the run; a second call with the same idempotency key gets the answer of the first one."""
    controller, actor = controller_of(request), actor_of(request)
    run = permitted_run(controller, actor, name, Operation.RESUME_RUN)
    return resume(controller, actor, run, body.changes(), idempotency_key, dry_run=body.dry_run)


@router.post("/runs/{name}/clone")
def clone_run(
    request: Request, name: str, body: CloneRequest, idempotency_key: IdempotencyKey = None
) -> dict[str, Any]:
    """Submit a job that begins a new run with the weights of this one; a second call with the same idempotency key gets the answer of the first one."""
    controller, actor = controller_of(request), actor_of(request)
    run = permitted_run(controller, actor, name, Operation.CLONE_RUN)
    if body.dry_run:
        return clones.check_clone(controller, actor, run, body.name, body.changes())
    return clones.clone(controller, actor, run, body.name, body.changes(), idempotency_key)
