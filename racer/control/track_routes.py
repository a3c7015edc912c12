"""The native API's routes for the racer's tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, ConfigDict, Field

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.api.turns import Turns
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError, ServerError, UsageError
from orchestrator.services.permissions import Shared
from racer.control.operations import LIST_TRACKS, MAKE_TRACK
from racer.control.track_orders import carry_out

router = APIRouter(route_class=StoreRoute)
_turns = Turns("other tracks are being drawn")
_Measure = Annotated[float | None, Field(default=None, allow_inf_nan=False)]


class MakeRequest(BaseModel):
    """A new track: of a preset or of a seed, with measures [m]; absent ones are those of ``muster tracks make``."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(max_length=128)
    preset: str | None = Field(default=None, max_length=128, description="exact straights and arcs")
    seed: int | None = Field(default=None, ge=0, lt=2**63, description="of a random closed curve")
    length: _Measure
    width: _Measure
    spacing: _Measure
    direction: str | None = Field(default=None, max_length=128, description="counter-clockwise or clockwise")
    roughness: _Measure
    least_radius: _Measure


@router.get("/tracks")
def list_tracks(
    request: Request,
    name: str | None = Query(default=None, max_length=130, description="this track alone, also ``random:SEED``"),
    rings: bool = Query(default=False, description="with the borders, for a drawing"),
) -> list[dict[str, Any]]:
    """The presets and the tracks of the store with their measures [m]; one that is damaged has a ``problem`` instead."""
    controller, actor = controller_of(request), actor_of(request)
    actor.check(LIST_TRACKS)
    if name is None:
        found: list[dict[str, Any]] = _request(controller, {"action": "list", "rings": rings})
        return found
    return [_request(controller, {"action": "show", "name": name, "rings": rings})]


@router.post("/tracks")
def make_track(request: Request, body: MakeRequest) -> dict[str, Any]:
    """Make a track from a preset or a seed, and keep it in the store, for good."""
    controller, actor = controller_of(request), actor_of(request)
    actor.check(MAKE_TRACK, Shared())
    controller.writes.check(adds=True)
    if (body.preset is None) == (body.seed is None):
        raise ClientError("give one of preset and seed")
    measures = body.model_dump(exclude={"name", "preset", "seed"}, exclude_none=True)
    for key in ("roughness", "least_radius"):
        if body.preset is not None and key in measures:
            raise ClientError(f"{key} belongs to seed; a preset's curves follow from its length")
    order = {"action": "make", "name": body.name, "preset": body.preset, "seed": body.seed, "measures": measures}
    made: dict[str, Any] = _request(controller, order, 400)
    return made


def picture(controller: Controller, name: str) -> bytes:
    """The PNG of a track. Raises ClientError."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "track.png"
        _request(controller, {"action": "show", "name": name, "output": str(path)})
        return path.read_bytes()


def _request(controller: Controller, order: Mapping[str, Any], status: int = 404) -> Any:
    """``status``: of the answer where the order can't be carried out. Raises ClientError."""
    try:
        with _turns.turn():
            return carry_out({**order, "store": str(controller.access.store.path)})
    except UsageError as error:
        raise ClientError(str(error), status) from None
    except ServerError as error:
        raise ClientError(str(error), 503) from None
