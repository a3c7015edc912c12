"""The comparison of runs: the table, the paired differences and the curves of ``muster compare``, over seeds with their spread."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import partial
from typing import Any
from urllib.parse import quote, urlencode

from fastapi import Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native import run_routes
from orchestrator.console.curves import number
from orchestrator.console.live import Recent
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.domain.errors import ClientError
from orchestrator.services.context import permitted_run, visible_runs
from orchestrator.services.permissions import Operation
from shared_store.contract.error_text import nearest
from shared_store.volume.comparison import (
    COLUMNS,
    ComparedRun,
    RunGroup,
    facts_of,
    grouped,
    sentence,
    spaced,
    span,
    versus,
)
from shared_store.volume.metrics import sampled

router = page_router("run", stored=True)

MOST = 40
"""Runs that are compared at once."""
_RECORDS = 600
"""Records that are read of each run, evenly spread over its history; the newest is among them."""
_POINTS = 200
_NO_METRICS = {"iteration", "env_steps", "time", "epoch"}
"""Numbers of a record that make no useful curve over the steps."""
_recent = Recent(2.0)


@router.get("/compare")
def compare(
    request: Request,
    runs: list[str] = Query(default=[], alias="run", max_length=MOST),
    metric: str = Query(default="", max_length=200),
) -> Response:
    """The page; ``run`` is a name, or a pattern such as ``ant-*``. ``metric``: of the curve; the reward where it is empty."""
    names = _chosen(request, runs) if runs else []
    groups = _groups(request, names)
    metrics = _metrics(groups)
    if metric and metrics and metric not in metrics:
        raise ClientError(f"no run here has a metric {metric!r}; {nearest(metric, metrics)}", 404)
    first = groups[0] if groups else None
    differences = [versus(group, groups[0]) for group in groups]
    return render(
        request,
        "compare.html",
        columns=[name.title() for name in COLUMNS],
        rows=[
            (group.cells(), [(run.name, f"/runs/{quote(run.name, safe='')}") for run in group.runs]) for group in groups
        ],
        differences=[(sentence(each), each["verdict"]) for each in differences if each],
        first=first.label if first else "",
        patterns=" ".join(runs),
        metrics=_by_prefix(metrics),
        metric=metric or "reward",
        curves=f"/compare/curves?{urlencode([('run', name) for name in names])}",
    )


@router.get("/compare/curves")
def curves(
    request: Request,
    runs: list[str] = Query(alias="run", max_length=MOST),
    metric: str = Query(default="reward", max_length=200),
) -> dict[str, Any]:
    """The curves of a metric over the environment steps: ``x``, and for each group its mean ``y``, ``low`` and ``high``.

    ``low`` and ``high`` are one standard deviation over its runs away; null where a single run has records.
    """
    groups = _groups(request, _chosen(request, runs))
    found = [curve for group in groups for run in group.runs if (curve := run.curve(metric))]
    at = spaced(span(found), _POINTS) if found else []
    return {"x": at, "xLabel": "environment steps", "lines": [_line(group, metric, at) for group in groups]}


def _line(group: RunGroup, metric: str, at: Sequence[float]) -> dict[str, Any]:
    found = {steps: (mean, spread, count) for steps, mean, spread, count in group.curve(metric, at)}
    values = [found.get(steps) for steps in at]
    line: dict[str, Any] = {"name": group.label, "y": [number(each[0]) if each else None for each in values]}
    if len(group.runs) > 1:
        for end, sign in (("low", -1), ("high", 1)):
            line[end] = [number(each[0] + sign * each[1]) if each and each[2] > 1 else None for each in values]
    return line


def _chosen(request: Request, patterns: Sequence[str]) -> list[str]:
    """The names that the patterns match, in the order of the patterns, which may be separated by spaces. Raises ClientError."""
    parts = [part for each in patterns for part in each.split()]
    _check_number(len(parts), "runs or patterns")
    is_pattern = {each: any(sign in each for sign in "*?[") for each in parts}
    controller, actor = controller_of(request), actor_of(request)
    known = [run.name for run in visible_runs(controller, actor)] if any(is_pattern.values()) else []
    chosen: dict[str, None] = {}
    for each in parts:
        matching = [name for name in known if fnmatchcase(name, each)] if is_pattern[each] else [each]
        if not matching:
            raise ClientError(f"no run matches {each[:128]}; the page of runs has their names", 404)
        chosen |= dict.fromkeys(matching)
    _check_number(len(chosen), "runs")
    return list(chosen)


def _check_number(number: int, what: str) -> None:
    if number > MOST:
        raise ClientError(f"these are {number} {what}; at most {MOST} are compared at once, so give fewer")


def _groups(request: Request, names: Sequence[str]) -> list[RunGroup]:
    """The runs in groups; pages of the same runs share the result. Raises ClientError for a run that does not exist, or that the caller may not see."""
    actor = actor_of(request)
    key = (id(controller_of(request)), actor, tuple(names))
    return _recent.get(key, lambda: grouped(map(partial(_facts, request), names)))


def _facts(request: Request, name: str) -> ComparedRun:
    described = run_routes.run_detail(request, name)
    run = permitted_run(controller_of(request), actor_of(request), name, Operation.READ_METRICS)
    checkpoints, evaluations = run_routes.run_checkpoints(request, name), run_routes.run_evaluations(request, name)
    return facts_of(described, sampled(run, _RECORDS), checkpoints, evaluations)


def _metrics(groups: Sequence[RunGroup]) -> list[str]:
    """The metrics for which at least one run has a number."""
    newest = [run.records[-1] for group in groups for run in group.runs if run.records]
    return sorted({name for each in newest for name, value in each.items() if number(value) is not None} - _NO_METRICS)


def _by_prefix(metrics: Sequence[str]) -> dict[str, list[str]]:
    """The metrics by what their names have before the first underscore; those that share it with no other one are the last group."""
    prefixes = {name: name.partition("_")[0] for name in metrics}
    counts, found = Counter(prefixes.values()), defaultdict[str, list[str]](list)
    for name in sorted(metrics, key=lambda name: (counts[prefixes[name]] == 1, name)):
        found[prefixes[name] if counts[prefixes[name]] > 1 else "other"].append(name)
    return found
