"""The live page of queues and compute: waiting jobs and their reasons, shares, hosts and their load, engines and their health."""

from __future__ import annotations

import time
from functools import partial
from typing import Any
from urllib.parse import urlencode

from fastapi import Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.queue_overview import FIRST, overview
from orchestrator.console.live import LiveParts, Recent, Table, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.control.controller import Controller
from orchestrator.services.permissions import Actor

router = page_router()

_OLD = 10.0
"""Seconds after which the page says how old an engine's list of hosts is."""
_recent = Recent()


@router.get("/queues")
def queues(request: Request, queue: str = Query(default="", max_length=128)) -> Response:
    """All tables, or those of one queue with more of its jobs."""
    tables = _tables(controller_of(request), actor_of(request), queue)
    address = f"/queues/stream?{urlencode({'queue': queue})}"
    return render(request, "queues.html", **tables, queue=queue, first=FIRST, stream=address)


@router.get("/queues/stream")
def queues_stream(request: Request, queue: str = Query(default="", max_length=128)) -> Response:
    """The changes in the tables, as events."""
    live, read = (
        LiveParts(request, "queues_live.html"),
        partial(_tables, controller_of(request), actor_of(request), queue),
    )
    return stream(request, lambda: live.changes(read()))


def _tables(controller: Controller, actor: Actor, queue: str) -> dict[str, Any]:
    """The rows of every table; open pages of the same queue share them."""
    return _recent.get((id(controller), actor, queue), partial(_read_tables, controller, actor, queue))


def _read_tables(controller: Controller, actor: Actor, queue: str) -> dict[str, Any]:
    found = overview(controller, actor, queue)
    now = 1000 * time.time()
    for engine in found["engines"]:
        engine["isOld"] = engine["toldAt"] is not None and now - engine["toldAt"] > 1000 * _OLD
    named = [(each["name"], each) for each in found["queues"]]
    waiting = [
        {**job, "queue": name, "place": place} for name, each in named for place, job in enumerate(each["front"], 1)
    ]
    shares = [{**share, "queue": name} for name, each in named for share in each["shares"]]
    return {
        "waiting": Table((job["id"], job) for job in waiting),
        "shares": Table((f"{each['queue']}/{each['share']}", each) for each in shares),
        **{
            kind: Table((each["name"], each) for each in found[kind])
            for kind in ("queues", "hosts", "engines", "computeEnvironments")
        },
    }
