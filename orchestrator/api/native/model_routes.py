"""The native API of the model registry: list models, register an exported policy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import actor_of, reconciler_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.control.reconciler import Reconciler
from orchestrator.persistence.models import RunRecord
from orchestrator.services.chosen_checkpoints import CONFLICT, choose
from orchestrator.services.context import owner_of_run, permitted_run, using
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Actor, Operation
from shared_store.volume import bundles, models
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.files import DamagedFile
from shared_store.volume.models import AlreadyRegistered, Model, ModelError, UnknownModel

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
    store = reconciler_of(request).store
    newest = [models.versions(store, name)[-1] for name in models.model_names(store)]
    return actor.shown([_described(model) for model in newest if actor.may_see(owner_of_model(model))])


@router.get("/models/{name}")
def read_model(
    request: Request,
    name: str,
    version: int | None = Query(default=None, ge=1, description="the newest where absent"),
    verify: bool = Query(default=False, description="read every file and check its digest"),
) -> Any:
    """A version of a model, with its policy contract, the SHA-256 of its weights and the numbers of all its versions; with ``verify``, ``problem`` names the damaged files."""
    reconciler, actor = reconciler_of(request), actor_of(request)
    model = find_model(reconciler, actor, name, version)
    actor.check(Operation.READ_MODEL, owner_of_model(model))
    found = _described(model, verify)
    try:
        found["contract"] = model.contract().document()
        found["weights"] = bundles.read_manifest(model.bundle)["files"].get(bundles.POLICY, {}).get("sha256")
    except DamagedBundle as error:
        found["problem"] = found.get("problem") or str(error)
    return actor.shown({**found, "versions": [each.version for each in models.versions(reconciler.store, name)]})


@router.post("/runs/{name}/models")
def register_model(request: Request, name: str, body: RegisterRequest) -> Any:
    """Keep the exported bundle of a checkpoint as the next version of a model, permanently."""
    reconciler, actor = reconciler_of(request), actor_of(request)
    run = permitted_run(reconciler, actor, name, Operation.REGISTER_MODEL)
    reconciler.check_writable(adds=True)
    if shortage := reconciler.disk.shortage("store"):
        raise ClientError(f"{shortage}; a model has a copy of its bundle", 503)
    checkpoint = choose(run, body.checkpoint)
    if checkpoint is None:
        raise ClientError(f"run {run.name} has no checkpoint yet, so there is no policy to register", CONFLICT)
    record = owner_of_run(reconciler, run)
    queue, owner = (record.queue, record.owner) if record else ("", None)
    try:
        with using(reconciler, run.name):
            there = models.versions(reconciler.store, body.name)
            if there:
                actor.check(Operation.REGISTER_MODEL, owner_of_model(there[-1]))
            facts = {"queue": queue, "owner": owner, "registered_by": actor.name}
            model = models.register(
                reconciler.store, body.name, run, checkpoint, facts, reconciler.peers.id, again=body.again
            )
    except AlreadyRegistered as error:
        raise ClientError(str(error), CONFLICT) from None
    except ModelError as error:
        raise ClientError(str(error)) from None
    except (DamagedBundle, DamagedFile) as error:
        raise ClientError(str(error), CONFLICT) from None
    except OSError as error:
        raise ClientError(f"model {body.name} can't be written ({error.strerror or error})", 503) from None
    return actor.shown(_described(model))


def find_model(reconciler: Reconciler, actor: Actor, name: str, version: int | None) -> Model:
    """A version of a model that the caller may see, the newest where none is named. Raises ClientError."""
    try:
        return models.find(reconciler.store, name, version, lambda model: actor.may_see(owner_of_model(model)))
    except UnknownModel as error:
        raise ClientError(str(error), 404) from None
    except (ModelError, DamagedFile) as error:
        raise ClientError(str(error)) from None


def entered_model(reconciler: Reconciler, entry: Mapping[str, Any]) -> Model:
    """The model of a league's entry, which every key may see with its league. Raises ClientError."""
    name, version = entry["model"]["name"], entry["model"]["version"]
    try:
        return next(model for model in models.versions(reconciler.store, name) if model.version == version)
    except StopIteration:
        raise ClientError(f"model {name}@{version} is not in the store any more", 404) from None
    except (ModelError, DamagedFile) as error:
        raise ClientError(str(error)) from None


def owner_of_model(model: Model) -> RunRecord:
    """The owner of a model: that of the run that it comes from. A damaged model is visible to keys with all queues alone."""
    try:
        queue = model.facts().get("queue")
    except DamagedBundle:
        queue = ""
    return RunRecord(name=model.reference, queue=queue if isinstance(queue, str) else "")


def _described(model: Model, verify: bool = False) -> dict[str, Any]:
    found: dict[str, Any] = {"name": model.name, "version": model.version, "path": str(model.path)}
    try:
        found = {**model.facts(), **found}
        if verify:
            model.verify()
            found["verified"] = True
    except DamagedBundle as error:
        found["problem"] = str(error)
    return found
