"""Resuming a run: a job that continues it from a checkpoint, with changes that its state allows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import facts_of
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import Status
from orchestrator.persistence.ownership import FoundRun
from orchestrator.services import submission
from orchestrator.services.chosen_checkpoints import CONFLICT, choose, refusal
from orchestrator.services.context import Context, Known, archived, using
from orchestrator.services.permissions import Actor
from orchestrator.services.runs import newest_job, spec_of
from orchestrator.services.sources import with_teacher
from orchestrator.services.spec_submission import Changes, check, commit_submission, inherited, submit
from orchestrator.services.submission import record_of
from orchestrator.services.texts import keep_again
from orchestrator.spec.changes import override
from orchestrator.spec.model import ALGORITHMS, Spec, Train, validate
from orchestrator.spec.settings import task_config
from shared_store.contract.error_text import counted, shown
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, NewerFormat, list_checkpoints
from shared_store.volume.contents import is_archived
from shared_store.volume.initial_weights import TeacherCopy
from shared_store.volume.layout import Run
from shared_store.volume.run_settings import changed_setting, changed_task, setting_at

_RATES = {"ppo": ("learning_rate", ", or train.ppo.schedule=fixed"), "rsl_rl": ("algorithm.learning_rate", "")}
"""Of each algorithm that adapts a learning rate: which setting is the first one, and what else helps who wants it back."""


def resume(
    controller: Controller,
    actor: Actor,
    run: Run,
    changes: Changes,
    idempotency_key: str | None = None,
    *,
    dry_run: bool = False,
) -> dict[str, Any]:
    """Submit a job that continues ``run``; everything that can be refused is refused before a job exists.

    Args:
        run: The run.
        changes: The changes. The run keeps its worlds; another number of nodes shares them anew.
        idempotency_key: A second call with it answers what the first one did.
        dry_run: Submit nothing, and answer the definition that would be registered, and its queue.

    Raises:
        ClientError: The run is complete or being written, the checkpoint is missing or damaged, a change is impossible.
    """
    with using(controller, run.name, cites=False):
        return with_teacher(
            controller, lambda teacher: _resume(controller, actor, run, changes, idempotency_key, teacher, dry_run)
        )


def _resume(
    controller: Controller,
    actor: Actor,
    run: Run,
    changes: Changes,
    idempotency_key: str | None,
    teacher: TeacherCopy | None,
    dry_run: bool,
) -> dict[str, Any]:
    found, checkpoints = facts_of(run), list_checkpoints(run)
    if found.is_missing():
        raise ClientError(f"run {run.name} was deleted a moment ago", 404)
    if is_archived(run):
        raise archived(run.name)
    record = record_of("resume", run.name, asdict(changes))
    with controller.database.session() as session:
        if earlier := _answered(Context(session, controller, actor, idempotency_key), record, found, checkpoints):
            return earlier
        document = spec_of(session, actor, found)
    with suppress(ClientError):  # refused below, with its reason
        document = override(document or {}, changes.all())
    keep_again(controller, actor, run, document)
    chosen = choose(run, changes.checkpoint)
    if chosen is not None:
        with suppress(DamagedCheckpoint):
            _ = chosen.manifest  # read, and kept: before others have to wait for it
    if chosen and changes.checkpoint is not None:
        try:
            chosen.verify()  # reads all of it
        except DamagedCheckpoint as error:
            raise refusal(run, chosen, error) from None

    def begin(known: Known) -> dict[str, Any]:
        with controller.writes.session() as session:
            context = Context(session, controller, actor, idempotency_key, teacher=teacher, known=known)
            if earlier := _answered(context, record, found, checkpoints):
                return earlier
            document = spec_of(session, actor, found)
            if document is None:
                raise ClientError(
                    f"run {run.name} was not started from a YAML spec: submit its definition again with MUSTER_RUN={run.name}"
                )
            document = inherited(actor, document)
            before = validate(document, f"run {run.name}", merged=False)  # the changes may mend it
            changed = override(document, changes.all())
            _check_algorithm(run, before, changed)
            spec = validate(changed, f"run {run.name}")
            _check_changes(run, before, spec)
            environment = {"MUSTER_RUN": run.name}
            if spec.train:
                if chosen:
                    _check_rate(run, chosen, spec, changes.assignments)
                    _check_progress(session, actor, found, spec, chosen)
                environment["MUSTER_WORLDS"] = str(_worlds(session, actor, found, before, spec, chosen))
            if chosen and changes.checkpoint is not None:
                environment["MUSTER_CHECKPOINT"] = chosen.name
            if dry_run:
                definition = check(context, spec, changes.directory, f"run {run.name}")
                return {"definition": definition, "queue": spec.queue}
            job = submit(context, spec, changes.directory, f"run {run.name}", environment, record=record)
            return {
                **submission.answer(job),
                "run": run.name,
                "iteration": chosen.iteration if chosen else 0,
                "kind": spec.kind,
            }

    return commit_submission(controller, begin)


def _answered(
    context: Context, record: Mapping[str, Any], run: FoundRun, saved: Sequence[Checkpoint]
) -> dict[str, Any] | None:
    """The answer to an earlier call with the same idempotency key. Raises ClientError where that was for another request."""
    job = submission.answered(context, record)
    if job is None:
        return None
    kind = "train" if (spec_of(context.session, context.actor, run) or {}).get("train") else "command"
    return {
        **submission.answer(job),
        "run": run.name,
        "iteration": saved[-1].iteration if saved else 0,
        "kind": kind,
    }


def _check_algorithm(run: Run, before: Spec, changed: Mapping[str, Any]) -> None:
    """Refuse another algorithm first: errors about its settings, which are the old one's, would only mislead."""
    new = setting_at(changed, "train.algorithm") or Train.model_fields["algorithm"].default
    if before.train and new != before.train.algorithm:
        raise ClientError(
            f"run {run.name}: train.algorithm is {before.train.algorithm} and can't become {shown(new)}, which can't continue from its "
            "state; start a new run for that"
        )


def _check_changes(run: Run, before: Spec, after: Spec) -> None:
    """A run is one history: the settings on which its state depends can't change."""
    if before.train is None or after.train is None:
        if before.kind != after.kind:
            raise ClientError(f"run {run.name} is a {before.kind} job; it can't continue as {after.kind}")
        return
    if difference := changed_task(task_config(after.train.task), dict(before.train), dict(after.train)):
        key, old, new = difference
        raise ClientError(
            f"run {run.name}: train.{key} is {_shown(old)} and can't become {_shown(new)}; start a new run for that: "
            f"muster clone {run.name} --name NEW begins one with its weights"
        )
    name = after.train.algorithm
    if changed := changed_setting(ALGORITHMS.get(name), before.train.overrides(), after.train.overrides()):
        key, *values, may = changed
        old, new = ("not set" if value is None else shown(value) for value in values)
        raise ClientError(
            f"run {run.name}: train.{name}.{key} is {old} and can't become {new}: it is part of what the run has learnt; "
            "start a new run for that"
            + (f": muster clone {run.name} --name NEW begins one with its weights" if may else "")
        )


def _shown(value: Any) -> str:
    return shown({} if value is None else value)


def _check_rate(run: Run, chosen: Checkpoint, after: Spec, assignments: Sequence[str]) -> None:
    """Refuse a learning rate that would have no effect: an adapted one continues from the checkpoint, unless the setting differs."""
    if after.train is None or after.train.algorithm not in _RATES:
        return
    name = after.train.algorithm
    key, hint = _RATES[name]
    requested = setting_at(override({}, assignments), f"train.{name}.{key}")  # whatever section holds the assignment
    if requested is None or (name == "ppo" and after.train.overrides().get("schedule") == "fixed"):
        return
    try:
        saved = chosen.manifest
    except DamagedCheckpoint:
        return  # the worker uses the one before
    rate = saved.get("learning_rate")
    if not isinstance(requested, int | float) or not isinstance(rate, int | float):
        return
    differs = setting_at(saved, f"train.{name}.{key}") != requested  # then it counts
    if not differs and not math.isclose(rate, requested, rel_tol=1e-6):  # a rate may be a float32
        raise ClientError(
            f"run {run.name}: train.{name}.{key} is {requested!r} already, so that the run would continue with "
            f"the rate of its checkpoint, which is {rate:.3g} now; set another value{hint}"
        )


def _check_progress(session: Session, actor: Actor, run: FoundRun, after: Spec, chosen: Checkpoint) -> None:
    """Refuse a run that is complete, and one that a newer Muster wrote.

    A job that was struck down after its last save still owes its evaluation: such a run may be resumed.
    """
    assert after.train is not None
    try:
        _ = chosen.manifest
    except NewerFormat as error:
        raise ClientError(f"run {run.name}: {error}", CONFLICT) from None
    except DamagedCheckpoint:
        pass  # the worker names it, sets it aside and uses the one before
    newest = newest_job(session, actor, run)
    owing = chosen.iteration == after.train.iterations and newest is not None and newest.status == Status.FAILED
    if chosen.iteration >= after.train.iterations and not owing:
        raise ClientError(
            f"run {run.name} is complete at iteration {chosen.iteration} of {after.train.iterations}; "
            f"to train it further: muster resume {run.name} --set train.iterations={chosen.iteration * 2} -f",
            CONFLICT,
        )


def _worlds(session: Session, actor: Actor, run: FoundRun, before: Spec, after: Spec, chosen: Checkpoint | None) -> int:
    """Number of worlds with which the run continues: those that it has, whatever the number of ranks. Raises ClientError where they don't fit."""
    assert before.train is not None and after.train is not None
    ranks = after.nodes.max * after.ranks_per_node
    total = after.train.worlds * ranks
    changed = before.train.worlds != after.train.worlds
    if changed and chosen is None:  # no checkpoint holds worlds yet
        return total
    worlds = _worlds_of(session, actor, run, before, chosen)
    if changed and total != worlds:
        assert chosen is not None
        raise ClientError(
            f"run {run.name}: checkpoint {chosen.name} holds {counted(worlds, 'world')}, this job would have {total} "
            f"({counted(after.nodes.max, 'node')} × {counted(after.ranks_per_node, 'rank')} × {after.train.worlds}); "
            "leave train.worlds as it is: the worlds are distributed over all ranks"
        )
    if worlds < ranks:
        raise ClientError(
            f"run {run.name}: {counted(worlds, 'world')} can't be distributed over {counted(ranks, 'rank')}; use fewer nodes"
        )
    return worlds


def _worlds_of(session: Session, actor: Actor, run: FoundRun, before: Spec, chosen: Checkpoint | None) -> int:
    """Number of worlds of the run, by its checkpoint, else by its newest job's variables or spec."""
    assert before.train is not None
    try:
        if chosen and isinstance(saved := chosen.manifest.get("worlds"), int):
            return saved
    except DamagedCheckpoint:
        pass
    if (newest := newest_job(session, actor, run)) and (distributed := newest.gang.options.worlds) is not None:
        return distributed
    return before.train.worlds * before.ranks_per_node * before.nodes.max
