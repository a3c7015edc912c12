"""The native API's routes for leagues."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Header, Query, Request

from orchestrator.api.http.requests import IDEMPOTENCY_HEADER, actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from racer.control import leagues
from racer.control.leagues import CreateRequest, DisqualifyRequest, EnterRequest, RaceRequest, RerunRequest

router = APIRouter(route_class=StoreRoute)


@router.get("/leagues")
def list_leagues(request: Request) -> list[dict[str, Any]]:
    """All leagues by name, with their rules; an altered one has a ``problem``."""
    return leagues.list_leagues(controller_of(request))


@router.post("/leagues")
def create_league(request: Request, body: CreateRequest) -> dict[str, Any]:
    """Create a league; its rules are never changed."""
    return leagues.create_league(controller_of(request), actor_of(request), body)


@router.get("/leagues/{name}")
def read_league(request: Request, name: str) -> dict[str, Any]:
    """The rules of a league, and how many entries it has."""
    return leagues.read_league(controller_of(request), name)


@router.get("/leagues/{name}/entries")
def league_table(
    request: Request, name: str, every: bool = Query(default=False, description="all entries of each racer")
) -> list[dict[str, Any]]:
    """The table, the first one ahead: of each racer the best entry, then those that are not ranked and why."""
    return leagues.league_table(controller_of(request), name, every=every)


@router.get("/leagues/{name}/entries/{number}")
def read_entry(request: Request, name: str, number: int) -> Any:
    """An entry with its race and, where it is disqualified, the ruling; ``problem`` tells what was altered in it or in its model."""
    return leagues.read_entry(controller_of(request), actor_of(request), name, number)


@router.post("/leagues/{name}/races")
def race(
    request: Request,
    name: str,
    body: RaceRequest,
    idempotency_key: str | None = Header(default=None, alias=IDEMPOTENCY_HEADER),
) -> dict[str, Any]:
    """Submit the evaluation of a model by the league's rules; a second call with the same idempotency key gets the answer of the first one."""
    return leagues.race(controller_of(request), actor_of(request), name, body, idempotency_key)


@router.post("/leagues/{name}/entries/{number}/races")
def rerun(
    request: Request,
    name: str,
    number: int,
    body: RerunRequest,
    idempotency_key: str | None = Header(default=None, alias=IDEMPOTENCY_HEADER),
) -> dict[str, Any]:
    """Submit the race of an entry once more, whether the league is open or not; on a CPU its laps are the same."""
    return leagues.rerun(controller_of(request), actor_of(request), name, number, body, idempotency_key)


@router.post("/leagues/{name}/entries")
def enter(request: Request, name: str, body: EnterRequest) -> dict[str, Any]:
    """Make an entry of a race that has ended: the model's digest, the evaluation and its laps, for good."""
    return leagues.enter(controller_of(request), actor_of(request), name, body)


@router.post("/leagues/{name}/entries/{number}/disqualify")
def disqualify(request: Request, name: str, number: int, body: DisqualifyRequest) -> dict[str, Any]:
    """Disqualify an entry for good, with the reason; the entry itself stays as it is. For the league's owner."""
    return leagues.disqualify(controller_of(request), actor_of(request), name, number, body)
