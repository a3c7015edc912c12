"""The rules of cloning: a new run that begins with the weights of a checkpoint and nothing else of it.

The weights are copied when the clone is submitted (:mod:`shared_store.volume.initial_weights`): its job may wait for days, so pruning or deleting
the source does no harm.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import facts_of
from orchestrator.domain.errors import ClientError
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.ownership import FoundRun, first_description, forget_gone_run
from orchestrator.services import submission
from orchestrator.services.chosen_checkpoints import CONFLICT, choose, manifest_of, refusal
from orchestrator.services.context import Context, Known, release, using, with_store
from orchestrator.services.permissions import Actor
from orchestrator.services.runs import spec_of
from orchestrator.services.sources import with_teacher
from orchestrator.services.spec_submission import Changes, check, commit_submission, inherited, submit
from orchestrator.services.submission import record_of
from orchestrator.services.texts import keep_again
from orchestrator.spec.changes import override
from orchestrator.spec.model import ALGORITHMS, Spec, Train, validate
from orchestrator.spec.settings import task_config
from shared_store.contract.error_text import Refused, shown
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint
from shared_store.volume.initial_weights import NewRun, RunExists, TeacherCopy
from shared_store.volume.layout import Run
from shared_store.volume.run_settings import changed_setting, merged


def clone(
    controller: Controller, actor: Actor, source: Run, name: str, changes: Changes, idempotency_key: str | None = None
) -> dict[str, Any]:
    """Submit a job whose run begins at iteration 0 with the weights of ``source``; refusals come before a job exists.

    Args:
        source: Whose weights.
        name: Of the new run, and of its job.
        changes: The changes of its spec, and the checkpoint.
        idempotency_key: A second call with it answers what the first one did.

    Raises:
        ClientError: The source is not a training, its checkpoint is missing or damaged, there is a run of the new name, a change is
            impossible, or the weights can't fit what was changed.
    """
    with using(controller, source.name):
        return with_teacher(
            controller, lambda teacher: _clone(controller, actor, source, name, changes, idempotency_key, teacher)
        )


def check_clone(controller: Controller, actor: Actor, source: Run, name: str, changes: Changes) -> dict[str, Any]:
    """The definition that :func:`clone` would register, its queue, and the run and checkpoint of its weights; nothing is submitted.

    Raises ClientError as :func:`clone`.
    """
    spec, chosen = _checked(controller, actor, source, name, changes)
    definition = _check_submission(controller, actor, spec, changes, name)
    return {
        "definition": definition,
        "queue": spec.queue,
        "parent": {"run": source.name, "iteration": chosen.iteration},
    }


def _clone(
    controller: Controller,
    actor: Actor,
    source: Run,
    name: str,
    changes: Changes,
    idempotency_key: str | None,
    teacher: TeacherCopy | None,
) -> dict[str, Any]:
    record = record_of("clone", source.name, name, asdict(changes))

    def answered_before(known: Known) -> dict[str, Any] | None:
        with controller.database.session() as session:
            return _answered(Context(session, controller, actor, idempotency_key, known=known), record)

    if earlier := with_store(controller, answered_before):
        return earlier
    spec, chosen = _checked(controller, actor, source, name, changes)
    new = controller.access.store.run(name)
    _check_submission(controller, actor, spec, changes, name)  # before the copy: not for who may not submit it
    controller.writes.check(adds=True)
    keep_again(controller, actor, source, spec.document())
    if shortage := controller.access.shortage():
        raise ClientError(f"{shortage}; a clone has a copy of the weights", 503)
    making = NewRun(controller.access.store, controller.access.peers.id, source.name, chosen)
    environment = {"MUSTER_RUN": name, "MUSTER_PARENT": f"{source.name}@{chosen.iteration}"}

    def begin(known: Known) -> dict[str, Any]:
        with controller.writes.session() as session:
            context = Context(session, controller, actor, idempotency_key, making, teacher, known)
            if earlier := _answered(context, record):
                return earlier
            _check_free(session, new, context.read("taken", partial(_is_taken, new)))
            forget_gone_run(session, new)
            job = submit(context, spec, changes.directory, f"clone {name}", environment, record=record)
            # before the commit: a job without its weights must not start
            description = first_description(new, job, job.owner, job.queue)
            context.publish(new.name, making, partial(making.publish, new.name, description))
            return {**submission.answer(job), "run": new.name, "parent": making.lineage, "kind": spec.kind}

    try:
        with making:
            try:
                making.copy()
            except DamagedCheckpoint as error:
                raise refusal(source, chosen, error) from None
            return commit_submission(controller, begin)
    except RunExists:
        raise ClientError(_EXISTS.format(new.name), CONFLICT) from None
    except OSError as error:
        raise ClientError(f"the weights can't be copied into {new.path} ({error.strerror or error})", 503) from None
    finally:
        release(controller, making)


def _checked(controller: Controller, actor: Actor, source: Run, name: str, changes: Changes) -> tuple[Spec, Checkpoint]:
    """The spec of the new run, and the checkpoint with its weights. Raises ClientError."""
    found = facts_of(source)
    with controller.database.session() as session:
        spec = _changed(session, actor, found, name, changes)
        new = Context(session, controller, actor).run(name)
    is_taken = _is_taken(new)
    with controller.database.session() as session:
        _check_free(session, new, is_taken)
    chosen = _choose(source, changes)
    _check_weights(source, chosen, spec)
    return spec, chosen


def _check_submission(controller: Controller, actor: Actor, spec: Spec, changes: Changes, name: str) -> dict[str, Any]:
    """The definition of the job, which may be submitted. Raises ClientError."""
    controller.engines.capacity(patience=FRESH)  # before a lock: its holder must not wait for an engine

    def call(known: Known) -> dict[str, Any]:
        with controller.database.session() as session:
            return check(Context(session, controller, actor, known=known), spec, changes.directory, f"clone {name}")

    return with_store(controller, call)


def _answered(context: Context, record: Mapping[str, Any]) -> dict[str, Any] | None:
    """The answer to an earlier call with the same idempotency key. Raises ClientError where that was for another request."""
    job = submission.answered(context, record)
    if job is None:
        return None
    parent = (context.found(job.run).description() or {}).get("parent")
    return {**submission.answer(job), "run": job.run, "parent": parent, "kind": "train"}


def _changed(session: Session, actor: Actor, source: FoundRun, name: str, changes: Changes) -> Spec:
    """The spec of the new run. Raises ClientError."""
    document = spec_of(session, actor, source)
    if document is None:
        raise ClientError(f"run {source.name} was not started from a YAML spec: there is nothing to clone")
    document = inherited(actor, document)
    named = next((each for each in changes.assignments if each.partition("=")[0] == "name"), None)
    if named is not None:
        raise ClientError(f"--set {named[:100]}: a clone has the name that --name gives it")
    before = validate(document, f"run {source.name}", merged=False)
    spec = validate(override(document, [*changes.all(), f"name={json.dumps(name)}"]), f"clone of run {source.name}")
    for which in (before, spec):
        if which.train is None:
            what = f"run {source.name} is" if which is before else "the changes make it"
            kind = f"{'an' if which.kind[0] in 'aeiou' else 'a'} {which.kind} job"
            raise ClientError(f"{what} {kind}, and only a training has weights to begin with")
    return spec


def _choose(source: Run, changes: Changes) -> Checkpoint:
    """Raises ClientError where the checkpoint does not exist, or its description can't be read."""
    chosen = choose(source, changes.checkpoint)
    if chosen is None:
        raise ClientError(f"run {source.name} has no checkpoint yet, so there are no weights to begin with", 404)
    manifest_of(source, chosen)
    return chosen


def _check_weights(source: Run, chosen: Checkpoint, spec: Spec) -> None:
    """Refuse settings that the weights don't fit; only the rank knows the shapes of observations and actions."""
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
    settings, own = manifest["settings"], spec.train.overrides()
    if changed := changed_setting(ALGORITHMS.get(name), settings, merged(settings, own), settings, of_clone=True):
        key, old, new, _ = changed
        raise ClientError(
            f"{where} was trained with train.{name}.{key} {shown(old)}, which can't become {shown(new)}; leave the setting out"
        )
    if name in ALGORITHMS and (misfit := _of_other_size(manifest, spec.train)):
        key, then, now = misfit
        raise ClientError(
            f"{where} was trained with train.config.{key}: {then}; with {now}, as in the clone, its network has another size: "
            "leave the setting as it is, or submit a new training"
        )


def _of_other_size(manifest: Mapping[str, Any], train: Train) -> tuple[str, str, str] | None:
    """The first setting of an installed task for which the policy has another size than in a checkpoint: its key, then and now."""
    kind, learnt = task_config(train.task), manifest.get("train")
    if kind is None or not isinstance(learnt, dict) or manifest.get("task") != train.task:
        return None
    try:
        then, now = (kind.configured(config or {}).policy_sizes for config in (learnt.get("config"), train.config))
    except Refused:  # of what another version has written
        return None
    return next(((key, then[key], now[key]) for key in then if key in now and then[key] != now[key]), None)


_EXISTS = "run {} exists already: give the clone another --name"


def _is_taken(new: Run) -> bool:
    return new.path.is_symlink() or new.path.exists()


def _check_free(session: Session, new: Run, is_taken: bool) -> None:
    """Raises ClientError where the name is taken."""
    if not is_taken:
        return
    hint = ""
    if session.scalars(select(Job.id).where(Job.run == new.name).limit(1)).first() is None:
        # as after a crash between the run and its job
        hint = f"; no job has begun it: `muster resume {new.name}` does, or delete {new.path}"
    raise ClientError(_EXISTS.format(new.name) + hint, CONFLICT)
