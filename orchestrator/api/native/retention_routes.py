"""The native API of retention: what the rules would take and take, and the runs that a person archives or deletes."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import actor_of, reconciler_of
from orchestrator.api.http.store_route import WorkRoute
from orchestrator.control.reconciler import Reconciler
from orchestrator.control.retention import RunNeeded
from orchestrator.control.retention_looks import Place, Whose
from orchestrator.domain.retention import age_of
from orchestrator.services.context import permitted_run
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Actor, Operation
from shared_store.volume import contents

router = APIRouter(route_class=WorkRoute)

_A_PART = 2.0
"""Seconds of an answer: the rest of a pass comes with the next ones."""


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
    return _part(reconciler_of(request), actor_of(request), after, older_than, take=False)


@router.post("/gc")
def take_garbage(request: Request, body: TakeRequest) -> dict[str, Any]:
    """Take it: rows of jobs, their logs and outcomes, and runs that hold nothing else."""
    reconciler, actor = reconciler_of(request), actor_of(request)
    actor.check(Operation.TAKE_GARBAGE)
    reconciler.check_writable(adds=False)
    return _part(reconciler, actor, body.after, body.older_than, take=True)


class ArchiveRequest(BaseModel):
    """Whether a run is to be archived."""

    archived: bool = True


@router.post("/runs/{name}/archive")
def archive_run(request: Request, name: str, body: ArchiveRequest) -> dict[str, Any]:
    """Archive a run, so that nothing is added to it, it is left out of lists, and it is neither taken nor deleted; or take it out again."""
    reconciler, actor = reconciler_of(request), actor_of(request)
    run = permitted_run(reconciler, actor, name, Operation.ARCHIVE_RUN)
    with reconciler.retention.alone(run.name):
        if reconciler.retention.stored.facts([run.name])[run.name] is None:
            raise ClientError(f"run {run.name} was deleted a moment ago", 404)
        if body.archived and (job := reconciler.retention.open_job(run.name)):
            raise RunNeeded(
                f"run {run.name} is not archived, since job {job} has not ended; stop it first: muster stop {job}"
            )
        if body.archived:
            contents.archive(run, actor.name)
        else:
            contents.unarchive(run)
    return {"run": run.name, "archived": body.archived}


@router.delete("/runs/{name}")
def delete_run(request: Request, name: str) -> dict[str, Any]:
    """Delete a run with all that it holds, where nothing needs it. Answers its size; ``left`` is where in the trash the rest is that can't be removed."""
    reconciler, actor = reconciler_of(request), actor_of(request)
    run = permitted_run(reconciler, actor, name, Operation.DELETE_RUN)
    reconciler.check_writable(adds=False)
    return reconciler.retention.delete(run.name, _whose(actor))


def _whose(actor: Actor) -> Whose:
    return Whose(actor.name, actor.queues)


def _part(reconciler: Reconciler, actor: Actor, after: str, older_than: str, *, take: bool) -> dict[str, Any]:
    """The next part of a pass. Raises ClientError for a malformed member."""
    whose = _whose(actor)
    try:
        place = Place.of(after) if after else Place()
    except ValueError as error:
        raise ClientError(str(error)) from None
    try:
        older = age_of(older_than) if older_than else None
    except ValueError as error:
        raise ClientError(f"older_than: {error}") from None
    if not after:
        reconciler.retention.stored.look_again()  # others may have changed the store
    found: list[dict[str, Any]] = []
    deadline = time.monotonic() + _A_PART
    while True:
        rules = reconciler.retention.rules()
        rules = rules if older is None else replace(rules, default=older)
        looks, following = reconciler.retention.step(place, rules, take=take, whose=whose)
        found += looks
        if following is None or time.monotonic() > deadline:
            return {"runs": found, "next": None if following is None else str(following)}
        place = following
