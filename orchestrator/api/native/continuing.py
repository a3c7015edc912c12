"""The part shared by resuming and cloning a run: the checkpoint, the changed spec, and the job that is submitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from orchestrator.api.batch import definitions, submission
from orchestrator.api.batch import operations as batch
from orchestrator.api.checkpoints import CONFLICT
from orchestrator.api.context import Context, Known, with_store
from orchestrator.api.http import limits
from orchestrator.api.native.fitting import fit_of
from orchestrator.api.racing_tracks import check_tracks
from orchestrator.control.reconciler import Reconciler
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.gang import GangSpec, gang_needs
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.models import Job
from orchestrator.services import permissions
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Actor
from orchestrator.spec.compile import compile_definition, compile_submission
from orchestrator.spec.model import Spec


@dataclass(frozen=True)
class Changes:
    """The request for the new job."""

    checkpoint: int | Literal["best", "latest"] | None = None
    """Iteration, or what :func:`shared_store.volume.checkpoints.best_checkpoint` says; the newest where None."""
    assignments: tuple[str, ...] = ()
    """``key.path=value`` changes of the run's spec."""
    directory: str = ""
    """Working directory of the job."""
    nodes: int | None = None
    """Another number of nodes."""

    def all(self) -> list[str]:
        """The assignments, with the one that sets the number of nodes. Raises ClientError where both do."""
        if self.nodes is None:
            return [*self.assignments]
        for assignment in self.assignments:
            if assignment.partition("=")[0].partition(".")[0] == "nodes":
                raise ClientError(
                    f"--set {excerpt(assignment, 100)}: --nodes {self.nodes} sets the number of nodes; give one of them"
                )
        return [*self.assignments, f"nodes={self.nodes}"]


def answered(context: Context, run: str) -> Job | None:
    """The job that an earlier call with the same idempotency key has submitted. Raises ClientError where that was for another run."""
    job = submission.answered(context)
    if job is not None and job.run != run:
        raise ClientError(
            f"idempotency key {context.idempotency_key} was used for another request (job {job.id})", CONFLICT
        )
    return job


def check(context: Context, spec: Spec, directory: str, what: str) -> dict[str, Any]:
    """The definition of the job, which the caller may submit and which the queue could have. Raises ClientError."""
    definition = _definition(context, spec, directory)
    _check_fit(context, spec, gang_needs(definition["nodeProperties"]), what)
    return definition


def _definition(context: Context, spec: Spec, directory: str) -> dict[str, Any]:
    definition = compile_definition(spec, directory)
    context.actor.check(permissions.Operation.SUBMIT_JOB, permissions.JobsOf(context.queue(spec.queue).name))
    check_tracks(context.reconciler.store, spec.document(), context.read)
    limits.check_document("RegisterJobDefinition", definition)
    return definition


def _check_fit(context: Context, spec: Spec, gang: GangSpec, what: str) -> None:
    if problem := fit_of(context.session, context.actor, context.reconciler, context.queue(spec.queue), gang).problem:
        raise ClientError(f"{what}: {problem}")


def submit(
    context: Context,
    spec: Spec,
    directory: str,
    what: str,
    environment: Mapping[str, str],
    tags: Mapping[str, str] | None = None,
) -> tuple[dict[str, Any], Job]:
    """Register and submit the job; nothing is committed. Raises ClientError.

    Args:
        context: The call.
        spec: Of the job.
        directory: Its working directory.
        what: Begins the words of a refusal.
        environment: Added on every node.
        tags: Of the job.
    """
    definition = batch.validate("RegisterJobDefinition", _definition(context, spec, directory))
    registered, gang = definitions.register(context, definition)
    _check_fit(context, spec, gang, what)
    request = compile_submission(spec, registered["jobDefinitionArn"], environment, tags)
    answer = submission.submit_job(context, batch.validate("SubmitJob", request))
    context.session.flush()
    job = context.session.get(Job, answer["jobId"])
    assert job is not None
    return answer, job


def submit_alone(reconciler: Reconciler, actor: Actor, spec: Spec, directory: str, what: str) -> dict[str, Any]:
    """:func:`submit` of a job that neither continues nor begins a run, and its commit. Raises ClientError."""
    reconciler.engine.capacity(patience=FRESH)  # before the lock: its holder must not wait for an engine
    reconciler.check_writable(adds=True)

    def call(known: Known) -> dict[str, Any]:
        with reconciler.writing, reconciler.database.session() as session:
            return submit(Context(session, reconciler, actor, known=known), spec, directory, what, {})[0]

    answer = with_store(reconciler, call)
    reconciler.wake()
    return answer
