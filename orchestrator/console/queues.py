"""The live page of queues and compute: waiting jobs and their reasons, shares, hosts and their load, engines and their health."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any
from urllib.parse import urlencode

from fastapi import Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.queue_overview import FIRST, overview
from orchestrator.console import formats as words
from orchestrator.console.live import Recent, ServerSentEvent, TableRows, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.control.controller import Controller
from orchestrator.domain.job import Status
from orchestrator.domain.reasons import short_id, title
from orchestrator.services.permissions import Actor
from shared_store.contract.error_text import counted

router = page_router()

_OLD = 10.0
"""Seconds after which the page says how old an engine's list of hosts is."""
_recent = Recent()


@router.get("/queues")
def queues(request: Request, queue: str = Query(default="", max_length=128)) -> Response:
    """All tables, or those of one queue with more of its jobs."""
    actor = actor_of(request)
    tables = _tables(controller_of(request), actor, queue)
    return render(
        request,
        "queues.html",
        tables={name: list(rows.values()) for name, rows in tables.items()},
        blanks={name: of({}) for name, of in _ROWS.items()},
        queue=queue,
        first=FIRST,
        live=f"/queues/stream?{urlencode({'queue': queue})}",
    )


@router.get("/queues/stream")
def queues_stream(request: Request, queue: str = Query(default="", max_length=128)) -> Response:
    """The changes in the tables, as events."""
    actor = actor_of(request)
    look = partial(_tables, controller_of(request), actor, queue)
    known = {name: TableRows(name) for name in _ROWS}

    def changes() -> Sequence[ServerSentEvent]:
        return [event for name, rows in look().items() for event in known[name].changes(rows, {})]

    return stream(request, changes)


def _tables(controller: Controller, actor: Actor, queue: str) -> dict[str, dict[str, dict[str, Any]]]:
    """The rows of every table, by key; open pages of the same queue share them."""
    key = (id(controller), actor, queue)
    return _recent.get(key, partial(_read_tables, controller, actor, queue))


def _read_tables(controller: Controller, actor: Actor, queue: str) -> dict[str, dict[str, dict[str, Any]]]:
    found = overview(controller, actor, queue)
    waiting = [
        {**job, "queue": each["name"], "place": place}
        for each in found["queues"]
        for place, job in enumerate(each["front"], 1)
    ]
    shares = [{**share, "queue": each["name"]} for each in found["queues"] for share in each["shares"]]
    given = {**found, "waiting": waiting, "shares": shares}
    return {name: {row["key"]: row for row in map(of, given[name])} for name, of in _ROWS.items()}


def _queue(queue: Mapping[str, Any]) -> dict[str, Any]:
    counts = queue.get("counts") or {}
    waiting = counts.get(Status.RUNNABLE, 0)
    later = counts.get(Status.SUBMITTED, 0) + counts.get(Status.PENDING, 0)
    name = queue.get("name", "")
    return {
        "key": name,
        "name": name,
        "link": f"/queues?{urlencode({'queue': name})}" if name else "/queues",
        "jobs": f"/?{urlencode({'queue': name})}" if name else "/",
        "state": queue.get("state", ""),
        "priority": str(queue.get("priority", "")),
        "order": f"fair share: {queue['policy']}" if queue.get("policy") else "first in, first out",
        "waiting": f"{waiting}{f', {later} for other jobs' if later else ''}",
        "running": str(counts.get(Status.STARTING, 0) + counts.get(Status.RUNNING, 0)),
        "inUse": _amounts(queue.get("inUse")),
        "on": ", ".join(queue.get("computeEnvironments") or ()),
    }


def _job(job: Mapping[str, Any]) -> dict[str, Any]:
    job_id = job.get("id", "")
    return {
        "key": job_id,
        "place": str(job.get("place", "")),
        "queue": job.get("queue", ""),
        "name": title(job.get("name", ""), job_id),
        "short": short_id(job_id),
        "link": f"/jobs/{job_id}" if job_id else "/",
        "owner": job.get("owner") or "",
        "share": job.get("share") or "",
        "reason": job.get("reason") or "",
        "since": words.moment(job.get("since")),
    }


def _share(share: Mapping[str, Any]) -> dict[str, Any]:
    queue, name = share.get("queue", ""), share.get("share", "")
    return {
        "key": f"{queue}/{name}",
        "queue": queue,
        "name": name or "(none)",
        "weight": words.count(share.get("weight")),
        "used": words.duration(share.get("used")),
        "score": words.count(share.get("score")),
        "inUse": _amounts(share.get("inUse")),
    }


def _host(host: Mapping[str, Any]) -> dict[str, Any]:
    used = host.get("inUse") or {"cpus": 0, "gpus": 0, "memory": 0}
    cpus, gpus, memory = (host.get(kind, 0) for kind in ("cpus", "gpus", "memory"))
    return {
        "key": host.get("name", ""),
        "name": host.get("name", ""),
        "engine": host.get("engine", ""),
        "cpus": f"{used['cpus']:g} of {cpus:g}",
        "usedCpus": used["cpus"],
        "allCpus": cpus or 1,
        "gpus": f"{used['gpus']} of {gpus}" if gpus else "",
        "usedGpus": used["gpus"],
        "allGpus": gpus or 1,
        "memory": f"{_bytes(used['memory'])} of {_bytes(memory)}",
        "usedMemory": used["memory"],
        "allMemory": memory or 1,
        "state": "takes nothing now" if host.get("away") else "",
    }


def _engine(engine: Mapping[str, Any]) -> dict[str, Any]:
    told, failing, retry = engine.get("toldAt"), engine.get("failing", 0), engine.get("retry")
    is_old = told is not None and time.time() - told / 1000 > _OLD
    again = f"; next try in {words.duration(retry)}" if retry else "; trying again"
    return {
        "key": engine.get("name", ""),
        "name": engine.get("name", ""),
        "queue": engine.get("queue", ""),
        "kind": "queues by itself"
        if engine.get("queuesByItself")
        else "more hosts may come"
        if engine.get("elastic")
        else "",
        "state": "in trouble" if engine.get("problem") or failing else "answers" if told else "not heard yet",
        "health": "FAILED" if engine.get("problem") or failing else "SUCCEEDED" if told else "RUNNABLE",
        "old": words.moment(told) if is_old else "",
        "problem": engine.get("problem") or "",
        "failing": f"{counted(failing, 'gang')} can't be started or looked at{again}" if failing else "",
    }


def _compute_environment(compute_environment: Mapping[str, Any]) -> dict[str, Any]:
    hosts, cpus = compute_environment.get("hosts"), compute_environment.get("cpus")
    return {
        "key": compute_environment.get("name", ""),
        "name": compute_environment.get("name", ""),
        "engine": compute_environment.get("engine") or "",
        "state": compute_environment.get("state", ""),
        "hosts": "all of its engine" if hosts is None else ", ".join(hosts),
        "most": f"at most {cpus:g} CPUs" if cpus is not None else "",
    }


def _amounts(amounts: Mapping[str, float] | None) -> str:
    held = amounts or {}
    named = ((held.get("cpus", 0), "CPU"), (held.get("gpus", 0), "GPU"))
    return ", ".join(f"{amount:g} {unit}{'s' if amount != 1 else ''}" for amount, unit in named if amount)


def _bytes(mebibytes: int) -> str:
    return f"{mebibytes / 1024:.3g} GiB" if mebibytes >= 1024 else f"{mebibytes} MiB"


_ROWS = {
    "queues": _queue,
    "waiting": _job,
    "shares": _share,
    "hosts": _host,
    "engines": _engine,
    "computeEnvironments": _compute_environment,
}
"""For each table a function of the texts of a row; all empty for the row that scripts copy."""
