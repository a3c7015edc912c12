"""The native API's routes for submissions: a spec becomes a job in one request."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Header, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import IDEMPOTENCY_HEADER, actor_of, controller_of
from orchestrator.services.permissions import Operation
from orchestrator.services.spec_submission import submit_spec
from orchestrator.services.submission import answer
from orchestrator.spec.file import from_document

router = APIRouter()


class SubmitRequest(BaseModel):
    """A job to be submitted."""

    spec: dict[str, Any] = Field(description="the job YAML, as JSON; files that belong into the job with their text")
    directory: str = Field(default="", max_length=4096, description="working directory of the job")
    environment: dict[str, str] = Field(default_factory=dict, description="variables added on every node")


@router.post("/jobs")
def submit_job(
    request: Request,
    body: SubmitRequest,
    idempotency_key: str | None = Header(default=None, alias=IDEMPOTENCY_HEADER),
) -> dict[str, Any]:
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
