"""Models: an exported policy becomes a version of a model, for good; and who may see which."""

from __future__ import annotations

from typing import Any, Literal

from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import RunRecord
from orchestrator.services.chosen_checkpoints import CONFLICT, choose
from orchestrator.services.context import owner_of_run, permitted_run, using
from orchestrator.services.permissions import Actor, Operation
from shared_store.volume import models
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.files import DamagedFile
from shared_store.volume.models import AlreadyRegistered, Model, ModelError, UnknownModel


def register(
    controller: Controller,
    actor: Actor,
    run_name: str,
    name: str,
    requested: int | Literal["best", "latest"] | None = None,
    *,
    again: bool = False,
) -> Model:
    """Keep the exported bundle of a checkpoint as the next version of a model.

    Args:
        run_name: The run of the checkpoint.
        name: Of the model.
        requested: Iteration of the checkpoint, ``best`` or ``latest``; the newest where None.
        again: Register a checkpoint that is a version of the model already.

    Raises:
        ClientError: There is no such checkpoint or no bundle of it, or the model is another's.
    """
    run = permitted_run(controller, actor, run_name, Operation.REGISTER_MODEL)
    controller.writes.check(adds=True)
    if shortage := controller.access.shortage():
        raise ClientError(f"{shortage}; a model has a copy of its bundle", 503)
    checkpoint = choose(run, requested)
    if checkpoint is None:
        raise ClientError(f"run {run.name} has no checkpoint yet, so there is no policy to register", CONFLICT)
    record = owner_of_run(controller, run)
    queue, owner = (record.queue, record.owner) if record else ("", None)
    try:
        with using(controller, run.name):
            existing = models.versions(controller.access.store, name)
            if existing:
                actor.check(Operation.REGISTER_MODEL, owner_of_model(existing[-1]))
            facts = {"queue": queue, "owner": owner, "registered_by": actor.name}
            return models.register(
                controller.access.store, name, run, checkpoint, facts, controller.access.peers.id, again=again
            )
    except (AlreadyRegistered, DamagedBundle, DamagedFile) as error:
        raise ClientError(str(error), CONFLICT) from None
    except ModelError as error:
        raise ClientError(str(error)) from None
    except OSError as error:
        raise ClientError(f"model {name} can't be written ({error.strerror or error})", 503) from None


def find_model(controller: Controller, actor: Actor, name: str, version: int | None) -> Model:
    """A version of a model that the caller may see, the newest where none is named. Raises ClientError."""
    try:
        return models.find(controller.access.store, name, version, lambda model: actor.may_see(owner_of_model(model)))
    except UnknownModel as error:
        raise ClientError(str(error), 404) from None
    except (ModelError, DamagedFile) as error:
        raise ClientError(str(error)) from None


def any_model(controller: Controller, name: str, version: int) -> Model:
    """A version of a model, whoever may see it: something else that the caller may see cites it. Raises ClientError."""
    try:
        return next(model for model in models.versions(controller.access.store, name) if model.version == version)
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


def described(model: Model, verify: bool = False) -> dict[str, Any]:
    found: dict[str, Any] = {"name": model.name, "version": model.version, "path": str(model.path)}
    try:
        found = {**model.facts(), **found}
        if verify:
            model.verify()
            found["verified"] = True
    except DamagedBundle as error:
        found["problem"] = str(error)
    return found
