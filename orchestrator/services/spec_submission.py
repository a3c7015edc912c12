"""The part shared by resuming and cloning a run: the checkpoint, the changed spec, and the job that is submitted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.gang import LARGEST_DEFINITION, GangSpec
from orchestrator.domain.gang_checks import checked_gang
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.batch_models import Job, JobQueue
from orchestrator.services import definitions, submission
from orchestrator.services.arns import definition_arn
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.context import Context, Known, with_store
from orchestrator.services.fit import fit_of, named_queue
from orchestrator.services.permissions import Actor, JobsOf, Operation
from orchestrator.services.sources import with_teacher
from orchestrator.services.stored_names import check_training
from orchestrator.services.submission import Submission
from orchestrator.spec.compile import compile_definition, compile_submission, long_texts, with_environment
from orchestrator.spec.model import Spec
from shared_store.volume.initial_weights import TeacherCopy


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


def inherited(actor: Actor, spec: Mapping[str, Any]) -> dict[str, Any]:
    """What a job of this actor has of a run's spec: all but another's share, in place of which it has that of the actor's key."""
    if actor.share is None:
        return dict(spec)
    kept = {key: value for key, value in spec.items() if key != "share" or value == actor.share}
    evaluation = kept.get("evaluation")
    if isinstance(evaluation, Mapping) and evaluation.get("share") not in (None, actor.share):
        kept["evaluation"] = {**evaluation, "share": None}
    return kept


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
    _check_fit(
        context,
        spec,
        named_queue(context.session, context.actor, spec.queue),
        checked_gang(definition["nodeProperties"]),
        what,
    )
    return definition


def _definition(context: Context, spec: Spec, directory: str) -> dict[str, Any]:
    if "\0" in directory:
        raise ClientError("directory: a zero byte is not possible; give the path of a directory")
    definition = compile_definition(spec, directory)
    context.actor.check(Operation.SUBMIT_JOB, JobsOf(named_queue(context.session, context.actor, spec.queue).name))
    check_training(context.controller.access.store, spec.document(), context.read)
    if len(json.dumps(definition).encode()) > LARGEST_DEFINITION:
        raise ClientError(
            f"the job's definition has more than {LARGEST_DEFINITION} bytes; shorten its environment and its command",
            413,
        )
    return definition


class Unfit(ClientError):
    """A job could never start in its queue, whatever else ended; ``key``: the section of its spec that asks for too much."""

    def __init__(self, problem: str, what: str, *, on_gpus: bool) -> None:
        of_evaluations = problem.startswith("evaluation: ")
        self.key = "evaluation" if of_evaluations else "resources"
        if what:
            super().__init__(f"{what}: {problem}")
        elif of_evaluations:
            super().__init__(f"{problem}; change evaluation.resources or evaluation.queue")
        else:
            lower = "lower nodes or resources (cpus may be a fraction)"
            tried = "; resources.gpus=0 and train.worlds=16 try it on CPUs, slowly" if on_gpus else ""
            super().__init__(f"resources: {problem}; {lower}{tried}")


def _check_fit(context: Context, spec: Spec, queue: JobQueue, gang: GangSpec, what: str) -> None:
    if problem := fit_of(context.session, context.actor, context.controller, queue, gang).problem:
        raise Unfit(problem, what, on_gpus=bool(spec.train and spec.resources.gpus))


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
        what: Begins the words of a refusal; empty where the spec is the caller's own, who then learns what to change.
        environment: Added on every node.
        tags: Of the job.

    Raises:
        ClientError: It can't be submitted as it is, or not by this actor.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
        TeacherNeeded: Its teacher's weights have to be copied first (:func:`.sources.with_teacher`).
    """
    document = _definition(context, spec, directory)
    queue = named_queue(context.session, context.actor, spec.queue)
    share = submission.open_queue(context, queue, spec.share)
    properties = with_environment(document["nodeProperties"], environment or {})
    gang = checked_gang(properties)
    definition = definitions.revision(context, spec.name, document, gang, again=False)
    context.actor.check(Operation.SUBMIT_JOB, definition)
    _check_fit(context, spec, queue, gang, what)
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
            share=share,
            priority=spec.priority,
            attempts=retry["attempts"],
            evaluate_on_exit=retry.get("evaluateOnExit", ()),
            timeout=timeout.get("attemptDurationSeconds"),
            tags=tags,
        ),
    )
    context.session.add(definition)  # not before: others share the commit, and what is refused must leave nothing in it
    context.session.flush()
    return job


def submit_spec(
    controller: Controller,
    actor: Actor,
    spec: Spec,
    directory: str,
    what: str = "",
    environment: Mapping[str, str] | None = None,
    idempotency_key: str | None = None,
) -> Job:
    """:func:`submit` of a job that neither continues nor begins a run, and its commit.

    Raises:
        ClientError: It can't be submitted as it is, or not by this actor.
        Unfit: It could never start.
        Unavailable: The store, the database or an engine does not answer.
    """
    for text in long_texts(spec):
        controller.access.calls.call(partial(controller.texts.keep, text.encode(), actor.name), works=True)
    controller.engines.capacity(patience=FRESH)  # before the lock: its holder must not wait for an engine
    controller.writes.check(adds=True)

    def with_copy(teacher: TeacherCopy | None) -> Job:
        def call(known: Known) -> Job:
            def submit_once(session: Session) -> Job:
                context = Context(session, controller, actor, idempotency_key, teacher=teacher, known=known)
                earlier = submission.answered(context)
                return earlier or submit(context, spec, directory, what, environment)

            return controller.writes.gather(submit_once)

        return with_store(controller, call)

    job = with_teacher(controller, with_copy)
    controller.alarm.ring()
    return job
