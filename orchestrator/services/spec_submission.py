"""The submission of a spec: the one way in which a job YAML, a resumed, cloned or evaluated run, and a race become a job."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.gang import LARGEST_DEFINITION, GangSpec
from orchestrator.domain.gang_checks import checked_gang
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.batch_models import Job, JobQueue
from orchestrator.services import submission
from orchestrator.services.chosen_checkpoints import check_training
from orchestrator.services.context import Context, Known, with_store
from orchestrator.services.fit import fit_of, named_queue
from orchestrator.services.permissions import Actor, JobsOf, Operation
from orchestrator.services.runs import newest_job
from orchestrator.services.sources import with_teacher
from orchestrator.services.submission import Submission, record_of
from orchestrator.spec.compile import compile_definition, long_texts, with_environment
from orchestrator.spec.model import Spec
from shared_store.volume.initial_weights import TeacherCopy

T = TypeVar("T")


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


def _share(context: Context, queue: JobQueue, spec: Spec) -> str | None:
    """The share that the job asks for: its spec's, else that of the run that it reads, unless the actor's own share is in its place.

    Raises StoreNeeded.
    """
    run = getattr(getattr(spec, spec.kind), "run", None)
    if spec.share or run is None or queue.policy is None or context.actor.share is not None:
        return spec.share
    found = context.found(run)
    if newest := newest_job(context.session, context.actor, found):
        return newest.share
    described = (found.description() or {}).get("spec")  # written by a job: it may say anything
    share = described.get("share") if isinstance(described, Mapping) else None
    return share if isinstance(share, str) else None


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


def _check_fit(context: Context, spec: Spec, queue: JobQueue, gang: GangSpec, what: str) -> None:
    """Raise ClientError where the job could never start in its queue, whatever else ended."""
    problem = fit_of(context.session, context.actor, context.controller, queue, gang).problem
    if problem is None:
        return
    if what:
        raise ClientError(f"{what}: {problem}")
    if problem.startswith("evaluation: "):
        raise ClientError(f"{problem}; change evaluation.resources or evaluation.queue")
    tried = (
        "; resources.gpus=0 and train.worlds=16 try it on CPUs, slowly" if spec.train and spec.resources.gpus else ""
    )
    raise ClientError(f"resources: {problem}; lower nodes or resources (cpus may be a fraction){tried}")


def submit(
    context: Context,
    spec: Spec,
    directory: str,
    what: str,
    environment: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
    record: Mapping[str, Any] | None = None,
) -> Job:
    """Register the definition, where the newest of its name is another one, and submit the job; nothing is committed.

    Args:
        spec: Of the job.
        directory: Its working directory.
        what: Begins the words of a refusal; empty where the spec is the caller's own, who then learns what to change.
        environment: Added on every node.
        tags: Of the job.
        record: Of the request (:func:`.submission.record_of`), where it may come again with its idempotency key.

    Raises:
        ClientError: It can't be submitted as it is, or not by this actor.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
        TeacherNeeded: Its teacher's weights have to be copied first (:func:`.sources.with_teacher`).
    """
    document = _definition(context, spec, directory)
    queue = named_queue(context.session, context.actor, spec.queue)
    share = submission.open_queue(context, queue, _share(context, queue, spec))
    properties = document["nodeProperties"]
    if environment:
        properties = with_environment(properties, environment)
    gang = checked_gang(properties)
    definition = submission.revision(context, spec.name, document, gang, again=False)
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
            record=record or {},
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


def commit_submission(controller: Controller, call: Callable[[Known], T]) -> T:
    """Carry out a call that submits a job and commits it, and have the controller look at once. Raises what the call raises, Unavailable."""
    controller.engines.capacity(patience=FRESH)  # before the lock: its holder must not wait for an engine
    controller.writes.check(adds=True)
    result = with_store(controller, call)
    controller.work_queue.alarm.set()
    return result


def submit_spec(
    controller: Controller,
    actor: Actor,
    spec: Spec,
    directory: str,
    what: str = "",
    environment: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
    idempotency_key: str | None = None,
) -> tuple[Job, bool]:
    """:func:`submit` of a job that neither continues nor begins a run, and its commit.

    Returns:
        The job, and whether it is new: an earlier call with the same idempotency key may have submitted it.

    Raises:
        ClientError: It can't be submitted as it is, or not by this actor; 409 where the key was used for another request.
        Unavailable: The store, the database or an engine does not answer.
    """
    for text in long_texts(spec):
        controller.access.calls.call(partial(controller.texts.keep, text.encode(), actor.name), works=True)
    record = record_of("submit", spec.document(), directory, dict(environment or {}), dict(tags or {}))

    def with_copy(teacher: TeacherCopy | None) -> tuple[Job, bool]:
        def call(known: Known) -> tuple[Job, bool]:
            def submit_once(session: Session) -> tuple[Job, bool]:
                context = Context(session, controller, actor, idempotency_key, teacher=teacher, known=known)
                if earlier := submission.answered(context, record):
                    return earlier, False
                return submit(context, spec, directory, what, environment, tags, record), True

            return controller.writes.gather(submit_once)

        return commit_submission(controller, call)

    return with_teacher(controller, with_copy)
