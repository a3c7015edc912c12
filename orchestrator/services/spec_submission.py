"""The part shared by resuming and cloning a run: the checkpoint, the changed spec, and the job that is submitted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from orchestrator.control.reconciler import Reconciler
from orchestrator.domain.arns import definition_arn
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.gang import LARGEST_DEFINITION, GangSpec, gang_needs
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.models import Job, JobQueue
from orchestrator.services import definitions, submission
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.context import Context, Known, with_store
from orchestrator.services.errors import ClientError
from orchestrator.services.fit import fit_of
from orchestrator.services.permissions import Actor, JobsOf, Operation
from orchestrator.services.racing_tracks import check_tracks
from orchestrator.services.submission import Submission
from orchestrator.spec.compile import compile_definition, compile_submission, with_environment
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
    """The definition of the job, which the actor may submit and which the queue could have. Raises ClientError."""
    definition = _definition(context, spec, directory)
    _check_fit(context, context.queue(spec.queue), gang_needs(definition["nodeProperties"]), what)
    return definition


def _definition(context: Context, spec: Spec, directory: str) -> dict[str, Any]:
    definition = compile_definition(spec, directory)
    context.actor.check(Operation.SUBMIT_JOB, JobsOf(context.queue(spec.queue).name))
    check_tracks(context.reconciler.store, spec.document(), context.read)
    if len(json.dumps(definition).encode()) > LARGEST_DEFINITION:
        raise ClientError(
            f"the job's definition has more than {LARGEST_DEFINITION} bytes; shorten its environment and its command",
            413,
        )
    return definition


def _check_fit(context: Context, queue: JobQueue, gang: GangSpec, what: str) -> None:
    if problem := fit_of(context.session, context.actor, context.reconciler, queue, gang).problem:
        raise ClientError(f"{what}: {problem}")


def submit(
    context: Context,
    spec: Spec,
    directory: str,
    what: str,
    environment: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
) -> Job:
    """Register the definition, where the newest of its name is another one, and submit the job; nothing is committed.

    Args:
        context: The call.
        spec: Of the job.
        directory: Its working directory.
        what: Begins the words of a refusal.
        environment: Added on every node.
        tags: Of the job.

    Raises:
        ClientError: It can't be submitted as it is, or not by this actor.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
        TeacherNeeded: Its teacher's weights have to be copied first (:func:`.sources.with_teacher`).
    """
    document = _definition(context, spec, directory)
    queue = submission.open_queue(context, context.queue(spec.queue), spec.share)
    properties = with_environment(document["nodeProperties"], environment or {})
    gang = gang_needs(properties)
    definition = definitions.register(context, spec.name, document, gang, again=False)
    context.actor.check(Operation.SUBMIT_JOB, definition)
    _check_fit(context, queue, gang, what)
    retry, timeout = document["retryStrategy"], document.get("timeout") or {}
    job = submission.submit(
        context,
        Submission(
            name=spec.name,
            queue=queue,
            definition=definition,
            properties=properties,
            gang=gang,
            record=compile_submission(spec, definition_arn(definition.name, definition.revision), environment, tags),
            share=spec.share,
            priority=spec.priority,
            attempts=retry["attempts"],
            evaluate_on_exit=retry.get("evaluateOnExit", ()),
            timeout=timeout.get("attemptDurationSeconds"),
            tags=tags,
        ),
    )
    context.session.flush()
    return job


def submit_alone(reconciler: Reconciler, actor: Actor, spec: Spec, directory: str, what: str) -> Job:
    """:func:`submit` of a job that neither continues nor begins a run, and its commit. Raises ClientError."""
    reconciler.engine.capacity(patience=FRESH)  # before the lock: its holder must not wait for an engine
    reconciler.check_writable(adds=True)

    def call(known: Known) -> Job:
        with reconciler.writing, reconciler.database.session() as session:
            return submit(Context(session, reconciler, actor, known=known), spec, directory, what)

    job = with_store(reconciler, call)
    reconciler.wake()
    return job
