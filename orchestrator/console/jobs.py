"""The page of all jobs: a live table of one window of them, and stopping several at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response
from fastapi.responses import RedirectResponse

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.job_list import JobSelection, ids_of, page_of_jobs
from orchestrator.console.forms import Form, Question, done, sent_form
from orchestrator.console.live import LiveParts, Recent, Table, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import Status
from orchestrator.services.context import queue_names
from orchestrator.services.permissions import Actor
from orchestrator.services.stop import stop as stop_jobs
from shared_store.contract.error_text import counted

router = page_router()

ROWS = 50
"""Jobs of a page."""
_LONGEST = 200
"""Characters of a search."""
_AT_ONCE = 50
"""Jobs that are stopped in one transaction."""
GROUPS: Mapping[str, tuple[Status, ...]] = {
    "": (),
    "waiting": (Status.SUBMITTED, Status.PENDING, Status.RUNNABLE),
    "running": (Status.STARTING, Status.RUNNING),
    "succeeded": (Status.SUCCEEDED,),
    "failed": (Status.FAILED,),
}
"""Statuses by the name of the page's filter."""
_recent = Recent()


@dataclass(frozen=True)
class _Choice:
    """The filter and the place of the page, as an address gives them; empty for all, and for the first page."""

    status: Annotated[str, Query(max_length=20)] = ""
    queue: Annotated[str, Query(max_length=128)] = ""
    search: Annotated[str, Query(max_length=_LONGEST)] = ""
    after: Annotated[str, Query(max_length=_LONGEST)] = ""
    before: Annotated[str, Query(max_length=_LONGEST)] = ""

    @property
    def filter(self) -> dict[str, str]:
        return {"status": self.status, "queue": self.queue, "search": self.search}

    @property
    def selection(self) -> JobSelection:
        """Raises ClientError."""
        return _selection(**self.filter)


_Chosen = Annotated[_Choice, Depends()]


@router.get("/jobs")
def list_of_jobs() -> Response:
    """The address under which the pages of jobs lie."""
    return RedirectResponse("/", 303)


@router.get("/")
def jobs(request: Request, choice: _Chosen) -> Response:
    """The table."""
    controller, actor = controller_of(request), actor_of(request)
    parts = _parts(controller, actor, choice)
    with controller.database.session() as session:
        queues = queue_names(session, actor)
    address = f"/jobs/stream?{urlencode(asdict(choice))}"
    return render(request, "jobs.html", **parts, queues=queues, chosen=choice.filter, stream=address)


@router.get("/jobs/stream")
def jobs_stream(request: Request, choice: _Chosen) -> Response:
    """The changes in a window of the table, as events."""
    live = LiveParts(request, "jobs_live.html", chosen=choice.filter)
    _ = choice.selection  # refused at once, if at all
    read = partial(_parts, controller_of(request), actor_of(request), choice)
    return stream(request, lambda: live.changes(read()))


@router.post("/jobs/stop")
def stop(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Stop the jobs that were chosen, or all that the filter finds."""
    controller, actor = controller_of(request), actor_of(request)
    chosen = {each: form.one(each) for each in ("status", "queue", "search")}
    if form.one("all") == "yes":
        found = _selection(**chosen)
        with controller.database.session() as session:
            ids = ids_of(session, actor, found)
    else:
        ids = form.every("job")
    if not ids:
        raise ClientError("no job that can be stopped is marked; mark some in the table first")
    several = counted(len(ids), "job")
    text = "Trainings save a checkpoint before they end, and can be resumed. Waiting jobs are cancelled."
    form.confirm(Question(f"Stop {several}?", text, f"Stop {several}"))
    refused: list[ClientError] = []
    for start in range(0, len(ids), _AT_ONCE):
        part = ids[start : start + _AT_ONCE]
        refused += stop_jobs(controller, actor, part, f"stopped in the console by {actor.name}").values()
    if refused:
        raise ClientError(f"{len(refused)} of {several} can't be stopped: {refused[0]}", 403)
    return done(request, _address(**chosen), f"{several} asked to stop")


def _selection(status: str, queue: str, search: str) -> JobSelection:
    if status not in GROUPS:
        raise ClientError(f"status {status!r} is not known; it is one of {', '.join(filter(None, GROUPS))}")
    if len(search) > _LONGEST:
        raise ClientError(f"the text to search for has more than {_LONGEST} characters")
    return JobSelection(GROUPS[status], queue, search)


def _parts(controller: Controller, actor: Actor, choice: _Choice) -> dict[str, Any]:
    """The live parts of a page of the table; open pages of all who see the same queues share them."""
    visible = None if actor.queues is None else tuple(sorted(actor.queues))
    return _recent.get((id(controller), visible, choice), partial(_read_parts, controller, actor, choice))


def _read_parts(controller: Controller, actor: Actor, choice: _Choice) -> dict[str, Any]:
    found = page_of_jobs(controller, actor, choice.selection, ROWS, choice.after, choice.before)
    counts, more, rows = found["counts"], "+" if found["areMore"] else "", found["jobs"]
    address = partial(_address, **choice.filter)
    return {
        "jobs": Table((job["id"], job) for job in rows),
        "tabs": [
            (
                name,
                _address(**{**choice.filter, "status": name}),
                f"{sum(counts.get(each, 0) for each in statuses or Status)}{more}",
            )
            for name, statuses in GROUPS.items()
        ],
        "pages": {
            "newest": address() if choice.after or choice.before else "",
            "newer": address(before=found["previous"]) if found["previous"] else "",
            "shown": f"{len(rows)} of {found['total']}{more}" if rows else "",
            "older": address(after=found["next"]) if found["next"] else "",
        },
    }


def _address(**query: str) -> str:
    return f"/?{text}" if (text := urlencode({name: value for name, value in query.items() if value})) else "/"
