"""The rules of cloning: a new run that begins with the weights of a checkpoint, and with nothing else of it.

The weights are copied when the clone is submitted (:mod:`shared_store.parent`): its job may wait for days, and the source's
retention, or somebody who deletes the source, need not know of it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy.orm import Session

from orchestrator.admission import fit_in_queue
from orchestrator.api import batch, definitions, limits, permissions, submission
from orchestrator.api.context import Context
from orchestrator.api.errors import ClientError
from orchestrator.api.runs import CONFLICT, resized, setting_at, spec_of
from orchestrator.controller import Controller
from orchestrator.definition import compile_definition, compile_submission, gang_needs
from orchestrator.engines.several import FRESH
from orchestrator.errors import SpecError
from orchestrator.excerpts import shown
from orchestrator.ownership import first_description, forget_gone_run
from orchestrator.spec import ALGORITHMS, Spec, override, validate
from orchestrator.tables import Job
from shared_store.checkpoints import Checkpoint, DamagedCheckpoint, NewerFormat, best_checkpoint, list_checkpoints
from shared_store.layout import Run
from shared_store.parent import NewRun, RunExists


@dataclass(frozen=True)
class Wanted:
    """What a clone is to be."""

    name: str
    """Of the new run, and of its job."""
    checkpoint: int | Literal["best"] | None = None
    """Iteration, or the one with the greatest score; the newest where None."""
    assignments: tuple[str, ...] = ()
    """``key.path=value`` changes of the source's spec."""
    directory: str = ""
    """Working directory of the job."""
    nodes: int | None = None
    """Another number of nodes."""


def clone(controller: Controller, source: Run, wanted: Wanted, idempotency_key: str | None = None) -> dict[str, Any]:
    """Submit a job whose run begins at iteration 0 with the weights of ``source``; what can be refused is refused before a job exists.

    Raises:
        ClientError: The source is no training, its checkpoint is missing or damaged, there is a run of the new name, a change is
            impossible, or the weights can't fit what was changed.
    """
    with controller.database.session() as session:
        if earlier := _answered(Context(session, controller, idempotency_key), wanted):
            return earlier
        spec = _changed(session, source, wanted)
        new = Context(session, controller).run(wanted.name)
    _check_free(new)
    chosen = _choose(source, wanted)
    _check_weights(source, chosen, spec)
    controller.engine.capacity(patience=FRESH)  # before the lock: its holder must not wait for an engine
    controller.check_writable(adds=True)
    if shortage := controller.disk.shortage("store"):
        raise ClientError(f"{shortage}; a clone has a copy of the weights", 503)
    making = NewRun(controller.store, controller.peers.id, source.name, chosen)
    try:
        try:
            making.copy()
        except DamagedCheckpoint as error:
            raise ClientError(
                f"run {source.name}: {error}; choose another{_others(source, chosen)}", CONFLICT
            ) from None
        with controller.writing, controller.database.session() as session:
            context = Context(session, controller, idempotency_key)
            if earlier := _answered(context, wanted):
                making.discard()
                return earlier
            _check_free(new)
            forget_gone_run(session, new)
            answer, job = _submit(context, spec, wanted, making.lineage)
            # before the commit: a job without its weights must not start
            making.publish(new.name, first_description(new, job, job.owner, job.queue))
    except RunExists:
        making.discard()
        raise _exists(new) from None
    except OSError as error:
        making.discard()
        raise ClientError(f"the weights can't be copied into {new.path} ({error.strerror or error})", 503) from None
    except BaseException:
        making.discard()
        raise
    making.close()
    controller.wake()
    return {**answer, "run": new.name, "parent": making.lineage, "kind": spec.kind}


def _answered(context: Context, wanted: Wanted) -> dict[str, Any] | None:
    """What an earlier call with the same idempotency key has done. Raises ClientError where that was for another run."""
    job = submission.answered(context)
    if job is None:
        return None
    if job.run != wanted.name:
        raise ClientError(f"idempotency key {context.idempotency_key} was used for another request (job {job.id})", 409)
    parent = (context.run(job.run).description() or {}).get("parent")
    return {**submission.answer(job), "run": job.run, "parent": parent, "kind": "train"}


def _changed(session: Session, source: Run, wanted: Wanted) -> Spec:
    """The spec of the new run. Raises ClientError."""
    document = spec_of(session, source)
    if document is None:
        raise ClientError(f"run {source.name} was not started from a YAML spec: there is nothing to clone")
    named = next((each for each in wanted.assignments if each.partition("=")[0] == "name"), None)
    if named is not None:
        raise ClientError(f"--set {named[:100]}: a clone has the name that --name gives it")
    changes = [*wanted.assignments, *resized(wanted.assignments, wanted.nodes), f"name={json.dumps(wanted.name)}"]
    try:
        before = validate(document, f"run {source.name}")
        spec = validate(override(document, changes), f"clone of run {source.name}")
    except SpecError as error:
        raise ClientError(str(error)) from None
    for which in (before, spec):
        if which.train is None:
            what = f"run {source.name} is" if which is before else "the changes make it"
            kind = f"{'an' if which.kind[0] in 'aeiou' else 'a'} {which.kind} job"
            raise ClientError(f"{what} {kind}, and only a training has weights to begin with")
    return spec


def _choose(source: Run, wanted: Wanted) -> Checkpoint:
    """Raises ClientError where there is no such checkpoint."""
    checkpoints = list_checkpoints(source)
    there = ", ".join(str(checkpoint.iteration) for checkpoint in checkpoints)
    if not checkpoints:
        raise ClientError(f"run {source.name} has no checkpoint yet, so there are no weights to begin with", 404)
    if wanted.checkpoint is None:
        chosen: Checkpoint | None = checkpoints[-1]
    elif wanted.checkpoint == "best":
        chosen = best_checkpoint(source)
        if chosen is None:
            raise ClientError(
                f"run {source.name}: no checkpoint has a score yet, which is a mean over at least 100 episodes; "
                f"name an iteration: {there}",
                404,
            )
    else:
        chosen = next((each for each in reversed(checkpoints) if each.iteration == wanted.checkpoint), None)
    if chosen is None:
        raise ClientError(f"run {source.name} has no checkpoint of iteration {wanted.checkpoint}; it has: {there}", 404)
    try:
        _ = chosen.manifest
    except NewerFormat as error:
        raise ClientError(f"run {source.name}: {error}", CONFLICT) from None
    except DamagedCheckpoint as error:
        raise ClientError(f"run {source.name}: {error}; choose another{_others(source, chosen)}", CONFLICT) from None
    return chosen


def _others(source: Run, chosen: Checkpoint) -> str:
    others = [str(each.iteration) for each in list_checkpoints(source) if each.name != chosen.name]
    return f" ({', '.join(others) or 'there is none'})"


def _check_weights(source: Run, chosen: Checkpoint, spec: Spec) -> None:
    """Refuse what the weights can't fit, as far as settings tell; shapes of observations and actions only the rank knows."""
    assert spec.train is not None
    manifest, name = chosen.manifest, spec.train.algorithm
    where = f"run {source.name}: checkpoint {chosen.name}"
    learnt = manifest.get("algorithm")
    if not isinstance(learnt, str) or not isinstance(manifest.get("settings"), dict):
        raise ClientError(f"{where} is of an older Muster, which knew no algorithms: it can't be cloned", CONFLICT)
    if learnt != name:
        if learnt in ALGORITHMS and name in ALGORITHMS:
            raise ClientError(
                f"{where} has weights of algorithm {learnt}, which {name} can't read; clone it with train.algorithm={learnt}, "
                "or with a module:Class of your own whose load_state_dict reads them"
            )
        return  # whether a class of the user's own reads them, or is read, only the rank can say
    settings, given = manifest["settings"], spec.train.given()
    may_change = getattr(ALGORITHMS.get(name), "clone_may_change", ())
    for key in getattr(ALGORITHMS.get(name), "fixed", ()):
        if key in may_change or (asked := setting_at(given, key)) is None or not _knows(settings, key):
            continue
        if asked != (there := setting_at(settings, key)):
            raise ClientError(
                f"{where} was learnt with train.{name}.{key} {shown(there)} and does not fit {shown(asked)}; leave the setting out"
            )


def _knows(settings: dict[str, Any], key: str) -> bool:
    """Whether the manifest tells the setting at all: an older Muster may not have had it."""
    return key.partition(".")[0] in settings


def _check_free(new: Run) -> None:
    """Raises ClientError where the name is taken."""
    if new.path.is_symlink() or new.path.exists():
        raise _exists(new)


def _exists(new: Run) -> ClientError:
    return ClientError(f"run {new.name} exists already: give the clone another --name", CONFLICT)


def _submit(context: Context, spec: Spec, wanted: Wanted, lineage: dict[str, Any]) -> tuple[dict[str, Any], Job]:
    """Register and submit the job; nothing is committed. Raises ClientError."""
    definition = compile_definition(spec, wanted.directory)
    shape = gang_needs(definition["nodeProperties"]).shape
    queue = context.queue(spec.queue)
    permissions.check(permissions.Operation.SUBMIT_JOB, permissions.JobsOf(queue.name))
    if problem := fit_in_queue(context.session, context.controller.engine, queue, shape).problem:
        raise ClientError(f"clone {wanted.name}: {problem}")
    limits.check_document("RegisterJobDefinition", definition)
    registered = definitions.register_job_definition(context, batch.validate("RegisterJobDefinition", definition))
    environment = {"MUSTER_RUN": wanted.name, "MUSTER_PARENT": f"{lineage['run']}@{lineage['iteration']}"}
    request = compile_submission(spec, registered["jobDefinitionArn"], environment)
    answer = submission.submit_job(context, batch.validate("SubmitJob", request))
    context.session.flush()
    job = context.session.get(Job, answer["jobId"])
    assert job is not None
    return answer, job
