"""The native API's routes for the model registry: list models, register an exported policy."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.services.models import described, find_model, owner_of_model, register
from orchestrator.services.permissions import Operation
from shared_store.volume import bundles, models
from shared_store.volume.bundles import DamagedBundle

router = APIRouter(route_class=StoreRoute)


class RegisterRequest(BaseModel):
    """Which policy of the run becomes the next version of which model."""

    name: str = Field(max_length=128, description="of the model")
    checkpoint: int | Literal["best", "latest"] | None = Field(
        default=None, description="iteration; best; latest, the newest, where absent"
    )
    again: bool = Field(default=False, description="register a checkpoint that is a version of the model already")


@router.get("/models")
def list_models(request: Request) -> Any:
    """The newest version of each model that the caller may see, by name."""
    actor = actor_of(request)
    store = controller_of(request).access.store
    newest = [models.versions(store, name)[-1] for name in models.model_names(store)]
    return actor.shown([described(model) for model in newest if actor.may_see(owner_of_model(model))])


@router.get("/models/{name}")
def read_model(
    request: Request,
    name: str,
    version: int | None = Query(default=None, ge=1, description="the newest where absent"),
    verify: bool = Query(default=False, description="read every file and check its digest"),
) -> Any:
    """A version of a model, with its policy contract, the SHA-256 of its weights and the numbers of all its versions; with ``verify``, ``problem`` names the damaged files."""
    controller, actor = controller_of(request), actor_of(request)
    model = find_model(controller, actor, name, version)
    actor.check(Operation.READ_MODEL, owner_of_model(model))
    found = described(model, verify)
    try:
        found["contract"] = model.contract().document()
        found["weights"] = bundles.read_manifest(model.bundle)["files"].get(bundles.POLICY, {}).get("sha256")
    except DamagedBundle as error:
        found["problem"] = found.get("problem") or str(error)
    return actor.shown({**found, "versions": [each.version for each in models.versions(controller.access.store, name)]})


@router.post("/runs/{name}/models")
def register_model(request: Request, name: str, body: RegisterRequest) -> Any:
    """Keep the exported bundle of a checkpoint as the next version of a model, permanently."""
    controller, actor = controller_of(request), actor_of(request)
    model = register(controller, actor, name, body.name, body.checkpoint, again=body.again)
    return actor.shown(described(model))
