"""The curves of a run as pages draw them: a window of its metrics, thinned here, however long the history is.

``GET /runs/{name}/curves`` answers ``{"iterations": [...], "series": {name: [...]}, "last": n, "first": n}``: the series have a value
(or null) for each of the iterations, which rise. ``from`` and ``to`` are a window of iterations, ``points`` the most of them, and each ``name`` a metric, or a group of them with a ``*`` at its end (``reward_*``); all numbers without a name.
``env_steps``, ``total_seconds`` and ``time`` are metrics too, and serve as the other axis.

``static/curves.js`` draws them: ``Chart`` a chart of any lines, ``RunCurves`` the charts of a run that its stream continues
(:class:`NewIterations`). The first six lines differ in colour, further ones in their dashes as well; a line with ``low`` and
``high`` has a band between them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from fastapi import Query, Request

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.console.live import Recent, ServerSentEvent
from orchestrator.console.routing import page_router
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Operation
from shared_store.volume.layout import Run
from shared_store.volume.learning_metrics import LEARNING
from shared_store.volume.metrics import finite, history_of, sampled

router = page_router("name", stored=True)

POINTS = 300
"""Points of a curve by default; a chart is seldom wider than that many points two pixels apart."""
_MOST_POINTS = 1000
_MOST_READ = 4000
"""Records that are read for a response."""
_RECORDS = 200
"""Iterations that one event brings; a page that has missed more reads its curves again."""
LABELS = {each.name: each.label for each in LEARNING}
"""Of the algorithms' metrics."""
_recent = Recent()


@router.get("/runs/{name}/curves")
def run_curves(
    request: Request,
    name: str,
    names: list[str] = Query(default=[], alias="name", max_length=100),
    begin: int = Query(default=0, alias="from", ge=0, lt=2**53),
    end: int | None = Query(default=None, alias="to", ge=0, lt=2**53),
    points: int = Query(default=POINTS, ge=2, le=_MOST_POINTS),
) -> dict[str, Any]:
    """A window of a run's metrics."""
    run = permitted_run(controller_of(request), actor_of(request), name, Operation.READ_METRICS)
    key = (str(run.path), tuple(names), begin, end, points)
    return _recent.get(key, partial(curves_of, run, names, begin, end, points))


def curves_of(
    run: Run, names: Sequence[str] = (), begin: int = 0, end: int | None = None, points: int = POINTS
) -> dict[str, Any]:
    """The response of the route; reads at most 4000 records. Raises OSError.

    Args:
        run: The run.
        names: Metrics, or groups ending on ``*``; all where empty.
        begin: First iteration.
        end: Last iteration; the newest where None.
        points: At most so many iterations; the first and the last of the window are among them.
    """
    last = max((each["iteration"] for each in sampled(run, 2)), default=0)
    until = last if end is None else min(end, last)
    count = until - begin + 1
    if count <= 0:
        found = []
    elif count <= _MOST_READ and (begin > 1 or count < points):
        found = history_of(run).after(begin - 1, count)
    else:
        found = sampled(run, min(_MOST_READ, points * math.ceil(last / count)))
    records = thinned([each for each in found if begin <= each["iteration"] <= until], points)
    return {"first": begin, "last": last, **columns(records, names or ["*"])}


def thinned(records: Sequence[Mapping[str, Any]], points: int) -> list[Mapping[str, Any]]:
    """At most ``points`` of the records, evenly spread, with the first and the last."""
    if len(records) <= points:
        return list(records)
    return [records[round(i * (len(records) - 1) / (points - 1))] for i in range(points)]


def columns(records: Sequence[Mapping[str, Any]], names: Iterable[str]) -> dict[str, Any]:
    """``iterations``, and of each metric that has numbers its values in ``series``; a group's name ends on ``*``.

    A metric with a value for each rank is one of each: ``rank_collect_seconds/0``.
    """
    iterations = [each["iteration"] for each in records]
    records = [_single(each) for each in records]
    known = sorted({name for each in records for name in each if name != "iteration"})
    series = {
        each: [number(record.get(each)) for record in records]
        for name in names
        for each in known
        if each == name or (name.endswith("*") and each.startswith(name[:-1]))
    }
    drawn = {name: values for name, values in series.items() if any(value is not None for value in values)}
    return {"iterations": iterations, "series": drawn}


class NewIterations:
    """The iterations that are new to the curves of one page."""

    def __init__(self, run: Run, newest: int | None, names: Sequence[str] = ("*",)) -> None:
        """``newest``: the last one that the page has; None: the next is the newest. ``names``: as :func:`columns`."""
        self.newest = newest
        self._run, self._names = run, names

    def changes(self) -> list[ServerSentEvent]:
        """The event ``metrics``, or none; its data are ``again`` where an attempt went back behind the page's last iteration, or it has missed too many."""
        newest = max((each["iteration"] for each in sampled(self._run, 2)), default=0)
        before, self.newest = self.newest, newest
        if before is None or newest == before:
            return []
        records = history_of(self._run).after(before, _RECORDS + 1) if newest > before else []
        if newest < before or len(records) > _RECORDS:
            return [ServerSentEvent("metrics", {"again": True})]
        # not ``newest``: one may have been written since that look, or a long history is not read to its end yet
        self.newest = records[-1]["iteration"] if records else before
        return [ServerSentEvent("metrics", columns(records, self._names))] if records else []


def position(iteration: int | None, log: Mapping[str, int]) -> str:
    """The id of an event: the page's last iteration and its positions in the log."""
    return json.dumps({"i": iteration, "l": log}, separators=(",", ":"))


def read_position(text: str) -> tuple[int | None, dict[str, int] | None]:
    """Iteration and log of :func:`position`; None for each if it can't be read."""
    try:
        read = json.loads(text)
        iteration, log = read["i"], read["l"]
        fits = all(isinstance(each, int) and 0 <= each < 2**63 for each in log.values())
        if fits and (iteration is None or isinstance(iteration, int)):
            return iteration, dict(log)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass
    return None, None


def _single(record: Mapping[str, Any]) -> Mapping[str, Any]:
    lists = {name: values for name, values in record.items() if isinstance(values, list)}
    return {**record, **{f"{name}/{i}": value for name, values in lists.items() for i, value in enumerate(values)}}


def number(value: Any) -> float | None:
    """The value in six digits; None unless it is a finite number; a truth value is not."""
    if finite(value) is None:
        return None
    return value if isinstance(value, int) or abs(value) > 1e6 else float(f"{value:.6g}")
