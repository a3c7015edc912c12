"""The live page of a job: its reason to wait, its curves, attempts, log, checkpoints, configuration and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fastapi import Request, Response
from fastapi.responses import RedirectResponse

from orchestrator.api.batch import operations as batch
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.routes import job_detail
from orchestrator.console.curves import LABELS, NewIterations, position, read_position
from orchestrator.console.job_config import before_it, code_of, differences
from orchestrator.console.job_log import ChosenLog, LiveLog
from orchestrator.console.job_view import JobViewState, is_near, views
from orchestrator.console.live import LiveParts, Recent, ServerSentEvent, Table, last_id, stream
from orchestrator.console.pages import may_change, render
from orchestrator.console.routing import page_router
from orchestrator.console.run_files import File, files_of
from orchestrator.console.run_parts import CHECKPOINTS, attempts_of, checkpoints_of, facts_of_job, headline_of
from orchestrator.console.submit_fields import written
from orchestrator.control.controller import Controller
from orchestrator.control.store_calls import StoreSilent
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import Status
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Actor, Operation
from orchestrator.services.texts import with_texts
from shared_store.volume.files import DamagedFile

router, _stored = page_router(), page_router(stored=True)
_recent = Recent()


@router.get("/jobs/{reference}")
def job(request: Request, reference: str) -> Response:
    """The page; a name or the start of an id is redirected to it. Without the store it has what the database knows."""
    controller, actor = controller_of(request), actor_of(request)
    detail = job_detail(request, reference)
    if detail["id"] != reference:
        return RedirectResponse(f"/jobs/{detail['id']}", 303)
    described = _described(controller, actor, detail["id"])
    definition = described["jobDefinition"].rpartition("/")[2]
    stored = _Stored(detail["spec"] or {})
    if detail["storeProblem"] is None:
        try:
            stored = controller.access.calls.call(partial(_read, controller, actor, detail))
        except StoreSilent as error:
            detail["storeProblem"] = str(error)
    spec, view, before = stored.spec, views.state(detail["id"]), stored.before
    return render(
        request,
        "job.html",
        **_parts(detail, definition, view, stored.checkpoints),
        frame=view.url,
        view=view,
        **_context(request, detail["id"]),
        job=detail,
        definition=definition,
        array=described.get("arrayProperties", {}),
        has_run=detail["results"] is not None,
        trains=bool(spec.get("train")),
        labels=LABELS,
        container=_container(spec),
        configuration=written(spec) if spec else "",
        code=code_of(spec),
        before=before,
        changed=differences(before[2], spec) if before and spec else [],
        files=stored.files,
    )


@_stored.get("/jobs/{reference}/stream")
def job_stream(request: Request, reference: str, chosen: ChosenLog) -> Response:
    """The changes of the page and the new lines of its log, as events. The id of an event is the page's position in both."""
    controller, actor = controller_of(request), actor_of(request)
    iteration, places = read_position(last_id(request))
    log = LiveLog(controller.logs, chosen, chosen.end() if places is None else places)
    live = LiveParts(request, "run_live.html", **_context(request, chosen.job))
    iterations = NewIterations(chosen.run, iteration)
    definition = _described(controller, actor, chosen.job)["jobDefinition"].rpartition("/")[2]
    is_over = False

    def read() -> tuple[dict[str, Any], dict[str, Any]]:
        detail = job_detail(request, chosen.job)
        view = views.state(chosen.job, is_seen=True)
        return detail, _parts(detail, definition, view, _checkpoints(controller, actor, detail))

    def changes() -> Sequence[ServerSentEvent] | None:
        """The events since the last read; None once the job is over and all its events have been sent."""
        nonlocal is_over
        if is_over:
            return None
        # before the log: nothing is written after the end
        detail, parts = _recent.get((id(controller), actor, chosen.job), read)
        has_ended = Status(detail["status"]).is_terminal
        events = live.changes(parts) + (iterations.changes() if detail["results"] is not None else [])
        lines, is_behind = log.changes(is_last=has_ended)
        events += [lines] if lines else []
        is_over = has_ended and not is_behind
        at = position(iterations.newest, log.places)
        return [ServerSentEvent(each.name, each.data, at) for each in events]

    return stream(request, changes, stored=True, during=log)


@dataclass(frozen=True)
class _Stored:
    """What the page has from the store."""

    spec: Mapping[str, Any]
    """With the texts of its files."""
    before: tuple[str, str, Mapping[str, Any]] | None = None
    """The other side of the comparison: :func:`before_it`."""
    files: Sequence[File] = ()
    checkpoints: Table = field(default_factory=Table)


def _read(controller: Controller, actor: Actor, detail: Mapping[str, Any]) -> _Stored:
    spec = with_texts(controller, detail["run"], detail["spec"] or {})
    files = _files(controller, actor, detail["run"]) if detail["results"] is not None else []
    return _Stored(spec, before_it(controller, actor, detail), files, _checkpoints(controller, actor, detail))


def _described(controller: Controller, actor: Actor, job_id: str) -> dict[str, Any]:
    """A job as the AWS Batch API describes it."""
    described: dict[str, Any] = batch.call(controller, actor, "DescribeJobs", {"jobs": [job_id]})["jobs"][0]
    return described


def _context(request: Request, job_id: str) -> dict[str, Any]:
    """What the macros of the live parts need beside the parts."""
    return {"id": job_id, "is_near": is_near(request), "marks": may_change(actor_of(request))}


def _parts(detail: Mapping[str, Any], definition: str, view: JobViewState, checkpoints: Table) -> dict[str, Any]:
    """The live parts of the page. It is loaded again once there is a run to see, and for a frame, which needs a policy of its own."""
    head = headline_of(detail)
    page = f"{'' if detail['results'] is None else 'with a run'} {view.text}"
    return {
        "headline": head,
        "show_view": head["isOver"],
        "facts": facts_of_job(detail, definition),
        "attempts": attempts_of(detail),
        "checkpoints": checkpoints,
        **({"page": page} if detail["storeProblem"] is None else {}),  # a store that is silent hides no run
    }


def _checkpoints(controller: Controller, actor: Actor, detail: Mapping[str, Any]) -> Table:
    """Those of the job's run; none where they can't be seen."""
    if detail["results"] is None:
        return Table()
    try:
        run = permitted_run(controller, actor, detail["run"], Operation.READ_CHECKPOINTS)
        return checkpoints_of(run, CHECKPOINTS)
    except (ClientError, OSError):
        return Table()


def _files(controller: Controller, actor: Actor, name: str) -> list[File]:
    try:
        return files_of(permitted_run(controller, actor, name, Operation.READ_RUN))
    except (ClientError, DamagedFile, OSError):
        return []


def _container(spec: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The code that the job runs."""
    training = spec.get("train") or {}
    command = spec.get("command")
    return [
        ("Task", str(training.get("task") or "")),
        ("Algorithm", str(training.get("algorithm") or "")),
        ("Command", " ".join(map(str, command)) if isinstance(command, list) else ""),
        ("Image", str(spec.get("image") or "")),
    ]


router.include_router(_stored)
