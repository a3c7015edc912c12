"""The native API's routes for retention: what the rules would take and take, and the runs that a person archives or deletes."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.http.store_route import WorkRoute
from orchestrator.services import retention

router = APIRouter(route_class=WorkRoute)


class TakeRequest(BaseModel):
    """Where to continue, and an age in place of the rules' default."""

    after: str = Field(default="", max_length=200, description="`next` of the answer before; empty at first")
    older_than: str = Field(
        default="",
        max_length=40,
        description="age of the jobs of queues without a rule, such as 30d; empty: as the rules say",
    )


@router.get("/gc")
def read_garbage(
    request: Request,
    after: str = Query(default="", max_length=200, description="`next` of the answer before; empty at first"),
    older_than: str = Query(
        default="", max_length=40, description="age of the jobs of queues without a rule, such as 30d"
    ),
) -> dict[str, Any]:
    """What the rules of retention would take of the caller's jobs and runs, a part at a time, and what of it is kept and why.

    ``next`` is None after the last part.
    """
    return retention.next_part(controller_of(request), actor_of(request), after, older_than, take=False)


@router.post("/gc")
def take_garbage(request: Request, body: TakeRequest) -> dict[str, Any]:
    """Take it: rows of jobs, their logs and outcomes, and runs that hold nothing else."""
    return retention.next_part(controller_of(request), actor_of(request), body.after, body.older_than, take=True)


class ArchiveRequest(BaseModel):
    """Whether a run is to be archived."""

    archived: bool = True


@router.post("/runs/{name}/archive")
def archive_run(request: Request, name: str, body: ArchiveRequest) -> dict[str, Any]:
    """Archive a run, so that nothing is added to it, it is left out of lists, and it is neither taken nor deleted; or take it out again."""
    retention.archive(controller_of(request), actor_of(request), name, archived=body.archived)
    return {"run": name, "archived": body.archived}


@router.delete("/runs/{name}")
def delete_run(request: Request, name: str) -> dict[str, Any]:
    """Delete a run with all that it holds, where nothing needs it. Answers its size; ``left`` is where in the trash the rest is that can't be removed."""
    return retention.delete(controller_of(request), actor_of(request), name)
