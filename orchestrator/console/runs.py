"""The pages of runs: the list of the store's runs, and one run with its checkpoints, evaluations, lineage and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote, urlencode

from fastapi import Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native import run_routes
from orchestrator.console import formats as words
from orchestrator.console.curves import number
from orchestrator.console.live import Recent, ServerSentEvent, TableRows, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.control.controller import Controller
from orchestrator.domain.reasons import short_id
from orchestrator.services.permissions import Actor
from orchestrator.services.runs import last_metrics, list_runs
from shared_store.volume.evaluations import told_changes
from shared_store.volume.learning_metrics import LEARNING, in_words
from shared_store.volume.metrics import finite, warnings_of

router = page_router(stored=True)

ROWS = 50
"""Runs of a page."""
_INTERVAL = 2.0
"""Seconds between two looks at the list, which reads several files of each run."""
METRICS = (
    "reward",
    "episode_length",
    "success",
    "steps_per_second",
    *(metric.name for metric in LEARNING),
)
"""Metrics that the page of a run draws, where the run has them; the page of its job has all."""
_listed = Recent(_INTERVAL * 0.9)
_recent = Recent()


@router.get("/runs")
def runs(
    request: Request, search: str = Query(default="", max_length=128), after: str = Query(default="", max_length=128)
) -> Response:
    """The list, by name, a page at a time."""
    actor = actor_of(request)
    rows = _window(controller_of(request), actor, search, after)
    is_full = len(rows) == ROWS
    return render(
        request,
        "runs.html",
        rows=list(rows.values()),
        blank=_row({}),
        search=search,
        first=_address("/runs", search) if after else "",
        later=_address("/runs", search, list(rows)[-1]) if is_full else "",
        live=_address("/streams/runs", search, after),
    )


@router.get("/streams/runs")  # not below /runs/, where it would hide a run of that name
def runs_stream(
    request: Request, search: str = Query(default="", max_length=128), after: str = Query(default="", max_length=128)
) -> Response:
    """The changes in a page of the list, as events."""
    actor = actor_of(request)
    table, controller = TableRows(), controller_of(request)
    return stream(request, lambda: table.changes(_window(controller, actor, search, after), {}), _INTERVAL, stored=True)


@router.get("/runs/{name}")
def run(request: Request, name: str) -> Response:
    """One run."""
    described, tables = _read_run(request, name)
    metrics = last_metrics(controller_of(request).access.store.run(name)) or {}
    return render(
        request,
        "run.html",
        run=described,
        train=_train(described),
        best=_judged(described),
        parent=described["parent"] or {},
        tables={key: list(rows.values()) for key, rows in tables.items()},
        blanks={key: of({}) for key, of in _TABLES.items()},
        progress=_progress(name, metrics),
        metrics=[each for each in METRICS if isinstance(metrics.get(each), int | float)],
        path=f"/runs/{quote(name, safe='')}",
        compare=_comparison(described),
    )


@router.get("/runs/{name}/stream")
def run_stream(request: Request, name: str) -> Response:
    """The changes in the tables of a run, as events; ``changed`` when it has new metrics."""
    _ = run_routes.run_detail(request, name)  # refused at once, if at all
    known = {key: TableRows(key) for key in _TABLES}
    controller, before = controller_of(request), [-1]

    def changes() -> Sequence[ServerSentEvent]:
        _, tables = _read_run(request, name)
        found = [event for key, rows in tables.items() for event in known[key].changes(rows, {})]
        metrics = last_metrics(controller.access.store.run(name)) or {}
        if (iteration := metrics.get("iteration", 0)) != before[0]:
            before[0] = iteration
            found.append(ServerSentEvent("changed", {"iteration": iteration, **_progress(name, metrics)}))
        return found

    return stream(request, changes, stored=True)


def _window(controller: Controller, actor: Actor, search: str, after: str) -> dict[str, dict[str, Any]]:
    """Rows of a page of the list, by the run's name; open pages with the same choice share them."""

    def look() -> dict[str, dict[str, Any]]:
        return {each["run"]: _row(each) for each in list_runs(controller, actor, after, ROWS, search)}

    return _listed.get((id(controller), actor, search, after), look)


def _read_run(request: Request, name: str) -> tuple[dict[str, Any], dict[str, dict[str, dict[str, Any]]]]:
    """A run as the API describes it, and the rows of the page's tables; open pages of the same run share them. Raises ClientError."""

    actor = actor_of(request)

    def look() -> tuple[dict[str, Any], dict[str, dict[str, dict[str, Any]]]]:
        described = run_routes.run_detail(request, name)
        given = {
            "jobs": described["jobs"][::-1],
            "checkpoints": run_routes.run_checkpoints(request, name)[::-1],
            "evaluations": [{**each, "run": name} for each in run_routes.run_evaluations(request, name)[::-1]],
        }
        return described, {key: {row["key"]: row for row in map(of, given[key])} for key, of in _TABLES.items()}

    return _recent.get((id(controller_of(request)), actor, name), look)


def _row(run: Mapping[str, Any]) -> dict[str, Any]:
    """The texts of a run's row; all empty for the row that scripts copy."""
    name, train, jobs = run.get("run", ""), _train(run), run.get("jobs") or []
    job = jobs[-1] if jobs else {}
    iterations = train.get("iterations")
    return {
        "name": name,
        "link": f"/runs/{quote(name, safe='')}" if name else "/runs",
        "task": str(train.get("task") or ""),
        "problem": run.get("problem") or "",
        "owner": run.get("owner") or "",
        "queue": run.get("queue") or "",
        "done": run.get("iteration") or 0,
        "iterations": iterations if isinstance(iterations, int) else 1,
        "progress": f"{run.get('iteration', 0)} of {iterations}" if isinstance(iterations, int) else "",
        "checkpoints": str(run.get("checkpoints", "")),
        "best": _judged(run),
        "job": job.get("name", ""),
        "jobLink": f"/jobs/{job['id']}" if job else "/",
        "status": job.get("status", ""),
        "created": words.moment(run.get("created")),
    }


def _train(run: Mapping[str, Any]) -> Mapping[str, Any]:
    """The ``train`` section of a run's spec; empty where there is none, since a store may hold anything."""
    train = (run.get("spec") or {}).get("train")
    return train if isinstance(train, Mapping) else {}


def _progress(run: str, metrics: Mapping[str, Any]) -> dict[str, str]:
    """The texts of the page that change with each iteration, from its record."""
    return {"learning": in_words(metrics), "warning": "; ".join(warnings_of(metrics, run))}


def _judged(run: Mapping[str, Any]) -> str:
    """The return of the best checkpoint where several are evaluated, else of the only evaluated one."""
    best, only = run.get("best"), run.get("evaluation")
    if best:
        return f"{words.count(best['mean'])} at {best['iteration']}"
    return f"{words.count(only['mean_return'])} at {int(only['checkpoint'].partition('-')[0])}" if only else ""


def _job(job: Mapping[str, Any]) -> dict[str, Any]:
    job_id = job.get("id", "")
    return {
        "key": job_id,
        "name": job.get("name", ""),
        "short": short_id(job_id),
        "link": f"/jobs/{job_id}" if job_id else "/",
        "status": job.get("status", ""),
    }


def _checkpoint(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    size, created = checkpoint.get("size"), number(checkpoint.get("created"))
    return {
        "key": checkpoint.get("name", ""),
        "name": checkpoint.get("name", ""),
        "path": checkpoint.get("path", ""),
        "iteration": str(checkpoint.get("iteration", "")),
        "reward": words.count(number(checkpoint.get("reward"))),
        "score": words.count(number(checkpoint.get("score"))),
        "evaluated": _interval(checkpoint.get("evaluated") or {}),
        "worlds": str(checkpoint.get("worlds") or ""),
        "size": f"{size / 2**20:.1f} MiB" if size is not None else "",
        "created": words.moment(created * 1000 if created else None),
        "note": checkpoint.get("problem") or ("the best" if checkpoint.get("best") else ""),
    }


def _evaluation(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    success, when = evaluation.get("success"), evaluation.get("time")
    told = evaluation.get("return")
    interval = {**(told if isinstance(told, Mapping) else {}), "mean": evaluation.get("mean_return")}
    share = finite(success.get("share")) if isinstance(success, Mapping) else None
    return {
        "key": evaluation.get("name", ""),
        "checkpoint": evaluation.get("checkpoint", ""),
        "table": f"/runs/{evaluation['run']}/files/evaluations/{evaluation['name']}.parquet" if evaluation else "/runs",
        "worlds": ", ".join(f"{place}: {value}" for place, value in told_changes(evaluation)),
        "seed": str(evaluation.get("seed") if evaluation.get("seed") is not None else ""),
        "episodes": str(evaluation.get("episodes", "")),
        "return": _interval(interval),
        "length": words.count(evaluation.get("mean_length")),
        "success": f"{100 * share:.1f} %" if share is not None else "",
        "when": words.moment(when * 1000 if isinstance(when, int | float) else None),
    }


def _interval(told: Mapping[str, Any]) -> str:
    """A mean, and half of its 95 % interval where that is known."""
    mean, high = finite(told.get("mean")), finite(told.get("high"))
    if mean is None:
        return ""
    return f"{mean:.2f} ± {high - mean:.2f}" if high is not None else f"{mean:.2f}"


_TABLES = {"jobs": _job, "checkpoints": _checkpoint, "evaluations": _evaluation}
"""For each table of a run a function of the texts of a row; all empty for the row that scripts copy."""


def _comparison(run: Mapping[str, Any]) -> str:
    """The address of the comparison with the run's parent and clones; empty where it has none."""
    parent = (run["parent"] or {}).get("run")
    others = [*([parent] if parent else []), *run["clones"]][:10]
    return f"/compare?{urlencode([('run', each) for each in (run['run'], *others)])}" if others else ""


def _address(path: str, search: str, after: str = "") -> str:
    query = urlencode({name: value for name, value in (("search", search), ("after", after)) if value})
    return f"{path}?{query}" if query else path
