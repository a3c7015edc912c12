"""The native API's routes for submissions: a spec becomes a job in one request; the long texts of jobs are kept before and read after."""

from __future__ import annotations

from functools import partial
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import PlainTextResponse, Response
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import IdempotencyKey, actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.domain.errors import ClientError
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Operation
from orchestrator.services.spec_submission import submit_spec
from orchestrator.services.submission import answer
from orchestrator.spec.file import from_document
from shared_store.volume.texts import Reference, TextError, digest_of, read

router = APIRouter()
texts = APIRouter(route_class=StoreRoute)


class SubmitRequest(BaseModel):
    """A job to be submitted."""

    spec: dict[str, Any] = Field(description="the job YAML, as JSON; files that belong into the job with their text")
    directory: str = Field(default="", max_length=4096, description="working directory of the job")
    environment: dict[str, str] = Field(default_factory=dict, description="variables added on every node")


@router.post("/jobs")
def submit_job(request: Request, body: SubmitRequest, idempotency_key: IdempotencyKey = None) -> dict[str, Any]:
    """Submit the job of a spec; a second call with the same idempotency key gets the answer of the first one.

    409 where that key came with another request. ``notes``: warnings about the spec.
    """
    controller, actor = controller_of(request), actor_of(request)
    actor.check(Operation.SUBMIT_SPEC)
    spec = from_document(body.spec, "spec")
    job, _ = submit_spec(
        controller,
        actor,
        spec,
        body.directory,
        environment=body.environment,
        idempotency_key=idempotency_key,
    )
    return {**answer(job), "run": job.run, "notes": list(spec.notes)}


@texts.put("/texts/{sha256}")
async def keep_text(request: Request, sha256: str) -> dict[str, str]:
    """Keep a text (UTF-8, the body) for jobs that name it by its digest: ``{file: NAME, sha256: …}`` in a task's configuration."""
    actor = actor_of(request)
    actor.check(Operation.KEEP_TEXT)
    controller, data = controller_of(request), await request.body()
    controller.writes.check(adds=True)
    try:
        found = digest_of(data.decode())
    except UnicodeDecodeError:
        raise ClientError("the body is not a text (UTF-8)") from None
    if found != sha256:
        raise ClientError(f"the text that came has sha256 {found}, not {sha256[:100]}; send it again")
    keep = partial(controller.texts.keep, data, actor.name)
    return {"sha256": await controller.access.calls.answer(keep, works=True)}


@texts.get("/runs/{name}/texts/{sha256}")
def run_text(request: Request, name: str, sha256: str) -> Response:
    """A long text of the run's jobs, such as a reward function, by the digest that their specs have."""
    run = permitted_run(controller_of(request), actor_of(request), name, Operation.READ_TEXT)
    try:
        return PlainTextResponse(read(run.texts, Reference(f"run {name}", "text", sha256)))
    except TextError:
        raise ClientError(f"run {name} has no text with sha256 {sha256[:100]}", 404) from None
