"""Jobs derived from a training: they evaluate, export or record the policy of one of its checkpoints, in the training's queue."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import facts_of
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import Job
from orchestrator.services.permissions import Actor
from orchestrator.services.runs import spec_of
from orchestrator.services.spec_submission import submit_spec
from orchestrator.spec.evaluations import document_beside, evaluation_document
from orchestrator.spec.model import validate
from shared_store.volume.layout import Run


def evaluate(controller: Controller, actor: Actor, run: Run, section: Mapping[str, Any], directory: str) -> Job:
    """Submit a job that evaluates a checkpoint.

    Args:
        controller: The controller.
        actor: Who asks; must be allowed to read the run.
        run: Of the training.
        section: What ``evaluate`` says beside the run.
        directory: Working directory of the job.

    Raises:
        ClientError: The run is no training, or the job can't be submitted.
    """
    document = evaluation_document(run.name, _trained(controller, actor, run), section)
    return _submitted(controller, actor, document, directory, f"evaluation of {run.name}")


def export(controller: Controller, actor: Actor, run: Run, section: Mapping[str, Any], directory: str) -> Job:
    """Submit a job that exports a checkpoint's policy; as :func:`evaluate`."""
    return _beside(controller, actor, run, "export", section, directory)


def record(controller: Controller, actor: Actor, run: Run, section: Mapping[str, Any], directory: str) -> Job:
    """Submit a job that records a checkpoint's policy at work; as :func:`evaluate`."""
    return _beside(controller, actor, run, "record", section, directory)


def _beside(
    controller: Controller, actor: Actor, run: Run, kind: str, section: Mapping[str, Any], directory: str
) -> Job:
    document = document_beside(run.name, _trained(controller, actor, run), kind, section)
    return _submitted(controller, actor, document, directory, f"{kind} of {run.name}")


def _trained(controller: Controller, actor: Actor, run: Run) -> Mapping[str, Any]:
    """The spec of a training. Raises ClientError where the run is none."""
    found = facts_of(run)
    with controller.database.session() as session:
        spec = spec_of(session, actor, found) or {}
    if not spec.get("train"):
        raise ClientError(f"run {run.name} is not a training, so it has no policy")
    return spec


def _submitted(controller: Controller, actor: Actor, document: Mapping[str, Any], directory: str, what: str) -> Job:
    return submit_spec(controller, actor, validate(dict(document), what), directory, what)[0]
