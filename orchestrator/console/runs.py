"""The pages of runs: the list of the store's runs, and one run with its checkpoints, evaluations, lineage and curves."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native import run_routes
from orchestrator.console.curves import LABELS, NewIterations, position, read_position
from orchestrator.console.formats import count
from orchestrator.console.live import LiveParts, Recent, ServerSentEvent, Table, last_id, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.console.run_parts import checkpoints_of, evaluations_of, learning_facts
from orchestrator.control.controller import Controller
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Actor, Operation
from orchestrator.services.runs import last_metrics, list_runs
from shared_store.volume.learning_metrics import LEARNING

router = page_router(stored=True)

ROWS = 50
"""Runs of a page."""
_INTERVAL = 2.0
"""Seconds between two polls of the list, which reads several files of each run."""
METRICS = (
    *("reward", "episode_length", "success", "steps_per_second"),
    *(metric.name for metric in LEARNING),
)
"""Metrics that the page of a run draws, where the run has them; the page of its job has all."""
_AXES = ("env_steps", "total_seconds")
_Name = Annotated[str, Query(max_length=128)]
_listed = Recent(_INTERVAL * 0.9)
_recent = Recent()


@router.get("/runs")
def runs(request: Request, search: _Name = "", after: _Name = "") -> Response:
    """The list, by name, a page at a time."""
    rows = _window(controller_of(request), actor_of(request), search, after)
    return render(
        request,
        "runs.html",
        runs=rows,
        search=search,
        first=_address("/runs", search) if after else "",
        later=_address("/runs", search, list(rows)[-1]) if len(rows) == ROWS else "",
        stream=_address("/streams/runs", search, after),
    )


@router.get("/streams/runs")  # not below /runs/, where it would hide a run of that name
def runs_stream(request: Request, search: _Name = "", after: _Name = "") -> Response:
    """The changes in a page of the list, as events."""
    live = LiveParts(request, "runs_live.html")
    read = partial(_window, controller_of(request), actor_of(request), search, after)
    return stream(request, lambda: live.changes({"runs": read()}), _INTERVAL, stored=True)


@router.get("/runs/{name}")
def run(request: Request, name: str) -> Response:
    """One run."""
    found, metrics, parts = _read_run(request, name)
    return render(
        request,
        "run.html",
        **parts,
        run=found,
        parent=found["parent"] or {},
        metrics=metrics,
        labels=LABELS,
        compare=_comparison(found),
    )


@router.get("/runs/{name}/stream")
def run_stream(request: Request, name: str) -> Response:
    """The changes of the page, as events. The id of an event is the page's position in the curves."""
    _ = run_routes.run_detail(request, name)  # refused at once, if at all
    live, (iteration, _) = LiveParts(request, "run_live.html"), read_position(last_id(request))
    iterations = NewIterations(controller_of(request).access.store.run(name), iteration, (*METRICS, *_AXES))

    def changes() -> list[ServerSentEvent]:
        events = live.changes(_read_run(request, name)[2]) + iterations.changes()
        return [ServerSentEvent(each.name, each.data, position(iterations.newest, {})) for each in events]

    return stream(request, changes, stored=True)


def _window(controller: Controller, actor: Actor, search: str, after: str) -> Table:
    """A page of the list, by the runs' names; open pages with the same choice share it."""
    read = partial(list_runs, controller, actor, after, ROWS, search)
    return _listed.get(
        (id(controller), actor, search, after), lambda: Table((each["run"], _row(each)) for each in read())
    )


def _read_run(request: Request, name: str) -> tuple[dict[str, Any], list[str], dict[str, Any]]:
    """A run as the API describes it, its metrics that are drawn, and the live parts; its open pages share them. Raises ClientError."""
    controller, actor = controller_of(request), actor_of(request)

    def read() -> tuple[dict[str, Any], list[str], dict[str, Any]]:
        found, run = (
            run_routes.run_detail(request, name),
            permitted_run(controller, actor, name, Operation.READ_CHECKPOINTS),
        )
        newest = last_metrics(run) or {}
        metrics = [each for each in METRICS if isinstance(newest.get(each), int | float)]
        train = _train(found)
        facts = [
            *((key.title(), train.get(key)) for key in ("task", "algorithm", "seed")),
            ("Queue", found["queue"]),
            ("Owner", found["owner"]),
            ("Best evaluation", _best(found)),
            ("In the store", found["path"]),
            ("Archived", "read-only" if found["archived"] else ""),
            *learning_facts(newest, name),
        ]
        parts = {
            "facts": facts,
            **({"page": "with curves"} if metrics else {}),
            "jobs": Table((job["id"], job) for job in found["jobs"][::-1]),
            "checkpoints": checkpoints_of(run),
            "evaluations": evaluations_of(run_routes.run_evaluations(request, name)[::-1], name),
        }
        return found, metrics, parts

    return _recent.get((id(controller), actor, name), read)


def _row(run: Mapping[str, Any]) -> dict[str, Any]:
    """A run of the list; one that can't be read has only its name and its problem."""
    names = ("run", "iteration", "checkpoints", "jobs", "queue", "owner", "created", "problem")
    return {**{name: run.get(name) or "" for name in names}, "train": _train(run), "best": _best(run)}


def _train(run: Mapping[str, Any]) -> Mapping[str, Any]:
    """The ``train`` section of a run's spec; empty where there is none, since a store may hold anything."""
    train = (run.get("spec") or {}).get("train")
    return train if isinstance(train, Mapping) else {}


def _best(run: Mapping[str, Any]) -> str:
    """The return of the best checkpoint where several are evaluated, else of the only evaluated one."""
    best, only = run.get("best"), run.get("evaluation")
    if best:
        return f"{count(best['mean'])} at {best['iteration']}"
    return f"{count(only['mean_return'])} at {int(only['checkpoint'].partition('-')[0])}" if only else ""


def _comparison(run: Mapping[str, Any]) -> str:
    """The address of the comparison with the run's parent and clones; empty where it has none."""
    parent = (run["parent"] or {}).get("run")
    others = [*([parent] if parent else []), *run["clones"]][:10]
    return f"/compare?{urlencode([('run', each) for each in (run['run'], *others)])}" if others else ""


def _address(path: str, search: str, after: str = "") -> str:
    query = urlencode({name: value for name, value in (("search", search), ("after", after)) if value})
    return f"{path}?{query}" if query else path
