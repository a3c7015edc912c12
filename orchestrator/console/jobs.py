"""The page of all jobs: a live table of one window of them, and stopping several at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.job_list import JobSelection, ids_of, page_of_jobs
from orchestrator.console import formats as words
from orchestrator.console.forms import Form, Question, done, sent_form
from orchestrator.console.live import Recent, ServerSentEvent, TableRows, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.domain.reasons import short_id
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
"""Jobs that TerminateJobs takes."""
GROUPS: Mapping[str, tuple[Status, ...]] = {
    "": (),
    "waiting": (Status.SUBMITTED, Status.PENDING, Status.RUNNABLE),
    "running": (Status.STARTING, Status.RUNNING),
    "succeeded": (Status.SUCCEEDED,),
    "failed": (Status.FAILED,),
}
"""States as the page's filter has them."""
_recent = Recent()


@dataclass(frozen=True)
class _Choice:
    """The filter and the page of the table, as an address gives them."""

    filter: Mapping[str, str]
    """``state``, ``queue`` and ``search``; empty for all."""
    wanted: JobSelection
    after: str
    before: str
    """The place of the page."""


def _choice(
    state: str = Query(default="", max_length=20),
    queue: str = Query(default="", max_length=128),
    search: str = Query(default="", max_length=_LONGEST),
    after: str = Query(default="", max_length=_LONGEST),
    before: str = Query(default="", max_length=_LONGEST),
) -> _Choice:
    chosen = {"state": state, "queue": queue, "search": search}
    return _Choice(chosen, _wanted(state, queue, search), after, before)


@router.get("/")
def jobs(request: Request, choice: _Choice = Depends(_choice)) -> Response:
    """The table."""
    actor = actor_of(request)
    controller, chosen = controller_of(request), choice.filter
    rows, totals = _window(controller, actor, choice)
    with controller.database.session() as session:
        queues = queue_names(session, actor)
    return render(
        request,
        "jobs.html",
        rows=list(rows.values()),
        blank=_row({}),
        totals=totals,
        groups=[(name, name or "all", _address(**{**chosen, "state": name})) for name in GROUPS],
        queues=queues,
        chosen=chosen,
        live=f"/jobs/stream?{urlencode({**chosen, 'after': choice.after, 'before': choice.before})}",
        newest=_address(**chosen) if choice.after or choice.before else "",
    )


@router.get("/jobs/stream")
def jobs_stream(request: Request, choice: _Choice = Depends(_choice)) -> Response:
    """The changes in a window of the table, as events."""
    actor = actor_of(request)
    table, look = TableRows(), partial(_window, controller_of(request), actor, choice)

    def changes() -> Sequence[ServerSentEvent]:
        return table.changes(*look())

    return stream(request, changes)


@router.post("/jobs/stop")
def stop(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Stop the jobs that were chosen, or all that the filter finds."""
    controller, actor = controller_of(request), actor_of(request)
    if form.one("all") == "yes":
        wanted = _wanted(form.one("state"), form.one("queue"), form.one("search"))
        with controller.database.session() as session:
            ids = ids_of(session, actor, wanted)
    else:
        ids = form.every("job")
    if not ids:
        raise ClientError("no job that could be stopped is chosen; mark some in the table first")
    several = counted(len(ids), "job")
    text = "Trainings save a checkpoint before they leave, and can be resumed. Waiting jobs are cancelled."
    form.confirm(Question(f"Stop {several}?", text, f"Stop {several}"))
    refused: list[ClientError] = []
    for start in range(0, len(ids), _AT_ONCE):
        part = ids[start : start + _AT_ONCE]
        refused += stop_jobs(controller, actor, part, f"stopped in the console by {actor.name}").values()
    if refused:
        raise ClientError(f"{len(refused)} of {several} can't be stopped: {refused[0]}", 403)
    return done(
        request, _address(*(form.one(each) for each in ("state", "queue", "search"))), f"{several} asked to stop"
    )


def _wanted(state: str, queue: str, search: str) -> JobSelection:
    if state not in GROUPS:
        raise ClientError(f"state {state!r} is not known; it is one of {', '.join(filter(None, GROUPS))}")
    if len(search) > _LONGEST:
        raise ClientError(f"the text to search for has more than {_LONGEST} characters")
    return JobSelection(GROUPS[state], queue, search)


def _window(controller: Controller, actor: Actor, choice: _Choice) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Rows of a page of the table, by id, and the totals; open pages of all who see the same queues share them."""
    seen = actor.queues
    key = (id(controller), None if seen is None else tuple(sorted(seen)), choice.wanted, choice.after, choice.before)
    return _recent.get(key, partial(_read_window, controller, actor, choice))


def _read_window(
    controller: Controller, actor: Actor, choice: _Choice
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    found = page_of_jobs(controller, actor, choice.wanted, ROWS, choice.after, choice.before)
    rows = {job["id"]: _row(job) for job in found["jobs"]}
    counts, more = found["counts"], "+" if found["areMore"] else ""
    totals = {
        name or "all": f"{sum(counts.get(each, 0) for each in states or Status)}{more}"
        for name, states in GROUPS.items()
    }
    beside = {
        "newer": _address(**choice.filter, before=found["previous"] or "") if found["previous"] else "",
        "older": _address(**choice.filter, after=found["next"] or "") if found["next"] else "",
    }
    return rows, {**totals, **beside, "shown": f"{len(rows)} of {found['total']}{more}" if rows else ""}


def _row(job: Mapping[str, Any]) -> dict[str, Any]:
    """The texts of a job's row; all empty for the row that scripts copy."""
    status, progress = job.get("status", ""), job.get("progress") or {}
    is_over = status in TERMINAL
    done_of = progress.get("iteration"), progress.get("iterations")
    attempt = job.get("attempt", 0)
    size = job.get("arraySize")
    return {
        "id": job.get("id", ""),
        "short": short_id(job.get("id", "")),
        "link": f"/jobs/{job['id']}" if job else "/",
        "name": job.get("name", ""),
        "kind": job.get("kind", ""),
        "status": status,
        "reason": (job.get("statusReason") or "") if status != Status.SUCCEEDED else "",
        "queue": job.get("queue", ""),
        "owner": job.get("owner") or "",
        "nodes": f"1 × {size}" if size else str(job.get("nodes", "")),
        "attempt": f"attempt {attempt} of {job['attemptsAllowed']}" if attempt > 1 else "",
        "done": done_of[0] or 0,
        "iterations": done_of[1] or 1,
        "progress": f"{done_of[0]} of {done_of[1]}" if progress else "",
        "rate": words.count(progress.get("stepsPerSecond")) if not is_over else "",
        "reward": words.count(progress.get("reward")),
        "spark": words.spark(progress.get("rewards") or ()),
        "created": words.moment(job.get("createdAt")),
        "took": "" if job.get("runsSince") else words.duration(job.get("ranSeconds")),
        "since": words.moment(job.get("runsSince")),
        "open": "" if is_over else "yes",
    }


def _address(state: str = "", queue: str = "", search: str = "", after: str = "", before: str = "") -> str:
    given = {"state": state, "queue": queue, "search": search, "after": after, "before": before}
    query = urlencode({name: value for name, value in given.items() if value})
    return f"/?{query}" if query else "/"
