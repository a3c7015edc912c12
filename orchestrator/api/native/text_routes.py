"""The native API's routes for the long texts of jobs: keep one, read one."""

from __future__ import annotations

from functools import partial

from fastapi import APIRouter, Request
from fastapi.responses import PlainTextResponse, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.domain.errors import ClientError
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Operation
from shared_store.volume.texts import Reference, TextError, digest_of, read

router = APIRouter(route_class=StoreRoute)


@router.put("/texts/{sha256}")
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


@router.get("/runs/{name}/texts/{sha256}")
def run_text(request: Request, name: str, sha256: str) -> Response:
    """A long text of the run's jobs, such as a reward function, by the digest that their specs have."""
    run = permitted_run(controller_of(request), actor_of(request), name, Operation.READ_TEXT)
    try:
        return PlainTextResponse(read(run.texts, Reference(f"run {name}", "text", sha256)))
    except TextError:
        raise ClientError(f"run {name} has no text with sha256 {sha256[:100]}", 404) from None
