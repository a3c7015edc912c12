"""The live page of a job: its reason to wait, its curves, attempts, log, checkpoints, configuration and files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fastapi import Request, Response
from fastapi.responses import RedirectResponse

from orchestrator.api.batch import operations as batch
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.routes import job_detail
from orchestrator.console.curves import columns
from orchestrator.console.job_config import before_it, code_of, differences
from orchestrator.console.job_facts import attempts_of, checkpoints_of, child_of, facts_of
from orchestrator.console.job_log import ChosenLog, LiveLog
from orchestrator.console.job_view import is_near, views
from orchestrator.console.live import Recent, ServerSentEvent, TableRows, last_id, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.console.run_files import File, files_of
from orchestrator.console.submit_fields import written
from orchestrator.control.controller import Controller
from orchestrator.control.store_calls import StoreSilent
from orchestrator.domain.errors import ClientError
from orchestrator.domain.reasons import short_id
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Actor, Operation
from orchestrator.services.texts import with_texts
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run
from shared_store.volume.learning_metrics import LEARNING
from shared_store.volume.metrics import history_of, sampled

router, _stored = page_router(), page_router(stored=True)

_recent = Recent()
_RECORDS = 200
"""Iterations that one event brings; a page that has missed more reads its curves again."""


@router.get("/jobs/{reference}")
def job(request: Request, reference: str) -> Response:
    """The page; a name or the start of an id is redirected to it. Without the store it has what the database knows."""
    controller, actor = controller_of(request), actor_of(request)
    detail = job_detail(request, reference)
    if detail["id"] != reference:
        return RedirectResponse(f"/jobs/{detail['id']}", 303)
    described = batch.call(controller, actor, "DescribeJobs", {"jobs": [detail["id"]]})["jobs"][0]
    array = described.get("arrayProperties", {})
    spec = detail["spec"] or {}
    is_visible = detail["results"] is not None
    before, files, checkpoints = None, list[File](), dict[str, Any]()
    if detail["storeProblem"] is None:
        try:
            spec, before, files, checkpoints = controller.access.calls.call(partial(_read, controller, actor, detail))
        except StoreSilent as error:
            detail["storeProblem"] = str(error)
    view = views.state(detail["id"])
    return render(
        request,
        "job.html",
        frame=view.url,
        view=view,
        is_near=is_near(request),
        job=detail,
        short=short_id(detail["id"]),
        facts=facts_of(detail),
        attempts=attempts_of(detail),
        blank_attempt=dict.fromkeys(_ATTEMPT, ""),
        checkpoints=checkpoints,
        blank_checkpoint=dict.fromkeys(_CHECKPOINT, ""),
        definition=described["jobDefinition"].rpartition("/")[2],
        children=[child_of(each) for each in detail["children"] or ()],
        array=array,
        has_run=is_visible,
        trains=bool(spec.get("train")),
        learning={each.name: each.label for each in LEARNING},
        container=_container(spec),
        nodes=range(detail["nodes"]),
        configuration=written(spec) if spec else "",
        code=code_of(spec),
        before=before,
        changed=differences(before[2], spec) if before and spec else [],
        parent=(detail["results"] or {}).get("parent") or {},
        files=files,
        pictures=[each for each in files if each.is_picture][:6],
    )


@_stored.get("/jobs/{reference}/stream")
def job_stream(request: Request, reference: str, chosen: ChosenLog) -> Response:
    """The changes of the page and the new lines of its log, as events. The id of an event is the page's position in both."""
    controller, actor = controller_of(request), actor_of(request)
    key = (id(controller), actor, chosen.job)
    look = partial(_recent.get, key, partial(_look, request, chosen.job))
    iteration, places = _had(last_id(request))
    log = LiveLog(controller.logs, chosen, chosen.end() if places is None else places)
    return stream(request, _Feed(look, log, chosen.run, iteration).changes, stored=True, during=log)


def _read(
    controller: Controller, actor: Actor, detail: Mapping[str, Any]
) -> tuple[Mapping[str, Any], tuple[str, str, Mapping[str, Any]] | None, list[File], dict[str, Any]]:
    """What the page has from the store: the spec with its texts, the other side of the comparison, the run's files, and its checkpoints."""
    spec = with_texts(controller, detail["run"], detail["spec"] or {})
    files = _files(controller, actor, detail["run"]) if detail["results"] is not None else []
    return spec, before_it(controller, actor, detail), files, _checkpoints(controller, actor, detail)


def _look(request: Request, job_id: str) -> dict[str, Any]:
    """The parts of the page that change; open pages of the same job share them."""
    actor = actor_of(request)
    detail = job_detail(request, job_id)
    facts = {**facts_of(detail), "view": views.state(job_id, is_seen=True).text}
    checkpoints = _checkpoints(controller_of(request), actor, detail)
    return {"facts": facts, "attempts": attempts_of(detail), "checkpoints": checkpoints}


def _checkpoints(controller: Controller, actor: Actor, detail: Mapping[str, Any]) -> dict[str, Any]:
    return checkpoints_of(controller, actor, detail["run"]) if detail["results"] is not None else {}


@dataclass
class _Feed:
    """The events that one page has been sent."""

    look: Any
    log: LiveLog
    run: Run
    iteration: int | None
    """The last iteration of its curves; None: it has none yet, and the next is the newest."""
    facts: dict[str, Any] = field(default_factory=dict)
    attempts: TableRows = field(default_factory=TableRows)
    checkpoints: TableRows = field(default_factory=TableRows)
    is_over: bool = False

    def changes(self) -> Sequence[ServerSentEvent] | None:
        """The events since the last look; None once the job is over and all its events have been sent."""
        if self.is_over:
            return None
        seen = self.look()  # before the log: nothing is written after the end
        events: list[ServerSentEvent] = []
        if changed := {name: value for name, value in seen["facts"].items() if self.facts.get(name) != value}:
            events.append(ServerSentEvent("facts", changed))
        self.facts = seen["facts"]
        for name, rows in (("attempts", self.attempts), ("checkpoints", self.checkpoints)):
            events += [ServerSentEvent(name, each.data) for each in rows.changes(seen[name], {})]
        if self.facts["run"]:
            events += self._curves()
        lines, is_behind = self.log.changes(is_last=not self.facts["open"])
        events += [lines] if lines else []
        self.is_over = not self.facts["open"] and not is_behind
        given = json.dumps({"i": self.iteration, "l": self.log.places}, separators=(",", ":"))
        return [ServerSentEvent(each.name, each.data, given) for each in events]

    def _curves(self) -> list[ServerSentEvent]:
        """New iterations; ``again`` where an attempt went back behind the page's last iteration, or the page has missed too many."""
        newest = max((each["iteration"] for each in sampled(self.run, 2)), default=0)
        had, self.iteration = self.iteration, newest
        if had is None or newest == had:
            return []
        records = history_of(self.run).after(had, _RECORDS + 1) if newest > had else []
        if newest < had or len(records) > _RECORDS:
            return [ServerSentEvent("metrics", {"again": True})]
        # not ``newest``: one may have been written since that look, or a long history is not read to its end yet
        self.iteration = records[-1]["iteration"] if records else had
        return [ServerSentEvent("metrics", columns(records, ["*"]))] if records else []


def _had(given: str) -> tuple[int | None, dict[str, int] | None]:
    """The page's position by the id of its last event: iteration and log; None for each that can't be read."""
    try:
        told = json.loads(given)
        iteration, places = told["i"], told["l"]
        fits = all(isinstance(each, int) and 0 <= each < 2**63 for each in places.values())
        if fits and (iteration is None or isinstance(iteration, int)):
            return iteration, dict(places)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass
    return None, None


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


_ATTEMPT = ("number", "epoch", "ending", "kind", "why", "started", "took", "since", "cost", "from", "span", "nodes")
_CHECKPOINT = (*("iteration", "epoch", "label", "reward", "score", "evaluated", "size", "created", "marks", "problem"),)


router.include_router(_stored)
