"""Routes and pages of notes."""

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, Field

from muster_notes import store as stored
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.services.context import permitted_run, visible_runs
from orchestrator.services.permissions import AddedOperation

router, pages = APIRouter(route_class=StoreRoute), page_router(stored=True)


class Note(BaseModel):
    """A note."""

    text: str = Field(pattern=r"\S", max_length=500)


@router.get("/notes")
def read_notes(request: Request) -> list[dict[str, object]]:
    """The notes on the runs that the caller may see."""
    controller, actor = controller_of(request), actor_of(request)
    notes = stored.notes(controller.access.store)
    seen = visible_runs(controller, actor, among=lambda run: run.name in notes)
    return [{"run": run.name, "notes": notes[run.name]} for run in seen]


@router.post("/notes/{run}")
def add_note(request: Request, run: str, body: Note) -> dict[str, str]:
    """Add a note on a run that the caller may change."""
    controller, actor = controller_of(request), actor_of(request)
    permitted_run(controller, actor, run, AddedOperation("POST /api/notes/{run}"))
    controller.writes.check(adds=True)
    stored.add(controller.access.store, run, body.text)
    return {"run": run}


@router.get("/notes/secret")
def forgotten() -> str:
    """Not among the operations of the plug-in: refused for every key."""
    return "secret"


@pages.get("/notes")
def page(request: Request) -> Response:
    """The same as a page."""
    return render(request, "notes.html", notes=read_notes(request))
