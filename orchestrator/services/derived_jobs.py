"""Jobs derived from a training: they evaluate, export or record the policy of one of its checkpoints, in the training's queue."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import facts_of
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import Job
from orchestrator.services.permissions import Actor
from orchestrator.services.runs import spec_of
from orchestrator.services.spec_submission import submit_spec
from orchestrator.spec.evaluations import evaluation_document
from orchestrator.spec.model import validate
from shared_store.volume.layout import Run

Kind = Literal["evaluate", "export", "record"]


def derive(
    controller: Controller, actor: Actor, run: Run, kind: Kind, section: Mapping[str, Any], directory: str
) -> Job:
    """Submit a job that evaluates, exports or records a checkpoint's policy.

    Args:
        actor: Who asks; must be allowed to read the run.
        run: Of the training.
        kind: What the job does.
        section: What its section of that name says beside the run.
        directory: Working directory of the job.

    Raises:
        ClientError: The run is not a training, or the job can't be submitted.
    """
    found = facts_of(run)
    with controller.database.session() as session:
        trained = spec_of(session, actor, found) or {}
    if not trained.get("train"):
        raise ClientError(f"run {run.name} is not a training, so it has no policy")
    what = f"{'evaluation' if kind == 'evaluate' else kind} of {run.name}"
    resources = None if kind == "evaluate" else {"cpus": 1, "memory": "2GiB"}
    document = evaluation_document(run.name, trained, section, kind=kind, resources=resources)
    return submit_spec(controller, actor, validate(document, what), directory, what)[0]
