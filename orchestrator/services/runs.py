"""Runs as the native API shows them, and the rules of resuming one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from orchestrator.control.reconciler import Reconciler
from orchestrator.control.run_store import RunFacts, facts_of
from orchestrator.domain.errors import SpecError
from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from orchestrator.domain.job import Status
from orchestrator.engines.registry import FRESH
from orchestrator.persistence.models import Job, RunRecord
from orchestrator.persistence.own_models import AutomaticEvaluation
from orchestrator.persistence.ownership import FoundRun, is_of_earlier_run, jobs_of, owner_of
from orchestrator.services import submission
from orchestrator.services.chosen_checkpoints import CONFLICT, choose, refusal
from orchestrator.services.context import Context, Known, archived, using, visible_runs, with_store
from orchestrator.services.damaged_rows import DamagedRow, reading
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Actor
from orchestrator.services.sources import with_teacher
from orchestrator.services.spec_submission import Changes, answered, submit
from orchestrator.services.texts import keep_again
from orchestrator.spec.changes import override
from orchestrator.spec.model import ALGORITHMS, Spec, Train, validate
from orchestrator.spec.settings import task_config
from shared_store.contract.error_text import counted, shown
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, NewerFormat, best_evaluated, list_checkpoints
from shared_store.volume.contents import is_archived
from shared_store.volume.evaluations import by_checkpoint
from shared_store.volume.files import DamagedFile
from shared_store.volume.initial_weights import TeacherCopy
from shared_store.volume.layout import Run
from shared_store.volume.metrics import sampled
from shared_store.volume.run_settings import first_difference, fixed_settings, innermost, setting_at


def list_runs(
    reconciler: Reconciler, actor: Actor, after: str, most: int, search: str = "", archived: bool = False
) -> list[dict[str, Any]]:
    """The first ``most`` runs behind the name ``after``, with ``search`` in their names, that the caller may see: those that are archived, or not.

    One that can't be read has a ``problem`` instead of its facts.
    """
    stored: list[StoredRun | dict[str, Any]] = []
    for run in visible_runs(reconciler, actor, after, most, search.strip(), lambda run: is_archived(run) == archived):
        try:
            stored.append(stored_run(run))
        except (DamagedFile, OSError) as error:
            problem = excerpt(" ".join(str(error).split()), LONGEST_REASON)
            stored.append({"run": run.name, "path": str(run.path), "problem": problem})
    names = [each.found.name for each in stored if isinstance(each, StoredRun)]
    with reconciler.database.session() as session:
        # one query instead of one a run: the session looks here first
        _known = session.scalars(select(RunRecord).where(RunRecord.name.in_(names))).all()
        return [described(session, actor, each) if isinstance(each, StoredRun) else each for each in stored]


def describe_run(reconciler: Reconciler, actor: Actor, run: Run) -> dict[str, Any]:
    """Facts of a run: its jobs, its newest checkpoint, and where its results lie. Raises DamagedFile, OSError."""
    stored = stored_run(run)
    with reconciler.database.session() as session:
        return described(session, actor, stored)


@dataclass(frozen=True)
class StoredRun:
    """What the store has of a run."""

    found: RunFacts
    results: Mapping[str, Any]


def stored_run(run: Run) -> StoredRun:
    """The part of :func:`describe_run` that the store has. Raises DamagedFile, OSError."""
    found = facts_of(run)
    description = found.description() or {}
    checkpoints = list_checkpoints(run)
    evaluated = _evaluated(run)
    newest = next((each.name for each in reversed(checkpoints) if each.name in evaluated), "")
    plot, picture = run.metrics / "reward.png", run.metrics / "policy.png"
    results = {
        "run": run.name,
        "path": str(run.path),
        "created": description.get("created"),
        "spec": description.get("spec"),
        "checkpoints": len(checkpoints),
        "iteration": checkpoints[-1].iteration if checkpoints else 0,
        "checkpoint": str(checkpoints[-1].path) if checkpoints else None,
        "plot": str(plot) if plot.exists() else None,
        "picture": str(picture) if picture.exists() else None,
        "evaluation": evaluated.get(newest),
        "best": _best(checkpoints, evaluated),
        "parent": description.get("parent"),
        "archived": is_archived(run),
    }
    return StoredRun(found, results)


def described(session: Session, actor: Actor, stored: StoredRun) -> dict[str, Any]:
    """:func:`describe_run` of what the store has, and the database."""
    run, results = stored.found, stored.results
    owner = owner_of(session, run)
    jobs = session.execute(
        select(Job.id, Job.name, Job.status).where(*_of_run(actor, run)).order_by(Job.created_at)
    ).all()
    return {
        **results,
        "owner": owner.owner if owner else None,
        "queue": owner.queue if owner else None,
        "spec": _shown_spec(session, actor, run, results["spec"]) if jobs else results["spec"],
        "jobs": [{"id": job.id, "name": job.name, "status": job.status} for job in jobs],
        "automatic": _automatic(session, actor, run),
    }


def describe_checkpoint(checkpoint: Checkpoint, verify: bool) -> dict[str, Any]:
    """Name, iteration, size [bytes], reward and creation time [Unix s]; with ``verify`` also its ``problem``."""
    facts: dict[str, Any] = {"name": checkpoint.name, "iteration": checkpoint.iteration, "epoch": checkpoint.epoch}
    facts["path"] = str(checkpoint.path)
    try:
        manifest = checkpoint.manifest
        facts |= {
            "size": checkpoint.size,
            "created": manifest.get("created"),
            "reward": manifest.get("reward"),
            "score": manifest.get("score"),
            "scoreError": manifest.get("score_error"),
            "scoreEpisodes": manifest.get("score_episodes"),
        }
        facts |= {"worlds": manifest.get("worlds"), "worldSize": manifest.get("world_size")}
        if verify:
            checkpoint.verify()
            facts["verified"] = True
    except DamagedCheckpoint as error:
        facts |= {"verified": False, "problem": str(error)}
    return facts


def spec_of(session: Session, actor: Actor, run: FoundRun) -> Mapping[str, Any] | None:
    """The spec with which a run continues: that of its newest job, else the one that it was created with. Raises DamagedRow."""
    newest = newest_job(session, actor, run)
    if newest:
        with reading(newest):
            return newest.gang.spec
    return (run.description() or {}).get("spec")


def _shown_spec(session: Session, actor: Actor, run: FoundRun, created: Any) -> Any:
    """:func:`spec_of`; that with which the run was ``created`` where the row of its newest job is damaged."""
    try:
        return spec_of(session, actor, run)
    except DamagedRow:
        return created


def resume(
    reconciler: Reconciler, actor: Actor, run: Run, changes: Changes, idempotency_key: str | None = None
) -> dict[str, Any]:
    """Submit a job that continues ``run``; everything that can be refused is refused before a job exists.

    Args:
        controller: The controller.
        run: The run.
        changes: The changes. The run keeps its worlds; another number of nodes shares them anew.
        idempotency_key: A second call with it answers what the first one did.

    Raises:
        ClientError: The run is complete or being written, the checkpoint is missing or damaged, a change is impossible.
    """
    with using(reconciler, run.name, cites=False):
        return with_teacher(
            reconciler, lambda teacher: _resume(reconciler, actor, run, changes, idempotency_key, teacher)
        )


def _resume(
    reconciler: Reconciler,
    actor: Actor,
    run: Run,
    changes: Changes,
    idempotency_key: str | None,
    teacher: TeacherCopy | None,
) -> dict[str, Any]:
    found, checkpoints = facts_of(run), list_checkpoints(run)
    if found.is_missing():
        raise ClientError(f"run {run.name} was deleted a moment ago", 404)
    if is_archived(run):
        raise archived(run.name)
    with reconciler.database.session() as session:
        if earlier := _answered(Context(session, reconciler, actor, idempotency_key), found, checkpoints):
            return earlier
        document = spec_of(session, actor, found)
    with suppress(SpecError, ClientError):  # refused below, with its reason
        document = override(document or {}, changes.all())
    keep_again(reconciler, actor, run, document)
    chosen = choose(run, changes.checkpoint)
    if chosen is not None:
        with suppress(DamagedCheckpoint):
            _ = chosen.manifest  # read, and kept: before others have to wait for it
    if chosen and changes.checkpoint is not None:
        try:
            chosen.verify()  # reads all of it
        except DamagedCheckpoint as error:
            raise refusal(run, chosen, error) from None
    reconciler.engine.capacity(patience=FRESH)  # before the lock: its holder must not wait for an engine
    reconciler.check_writable(adds=True)

    def begin(known: Known) -> dict[str, Any]:
        with reconciler.writing, reconciler.database.session() as session:
            context = Context(session, reconciler, actor, idempotency_key, teacher=teacher, known=known)
            if earlier := _answered(context, found, checkpoints):
                return earlier
            document = spec_of(session, actor, found)
            if document is None:
                raise ClientError(
                    f"run {run.name} was not started from a YAML spec: submit its definition again with MUSTER_RUN={run.name}"
                )
            try:
                before = validate(document, f"run {run.name}", merged=False)  # the changes may mend it
                changed = override(document, changes.all())
                _check_algorithm(run, before, changed)
                spec = validate(changed, f"run {run.name}")
            except SpecError as error:
                raise ClientError(str(error)) from None
            _check_changes(run, before, spec)
            environment = {"MUSTER_RUN": run.name}
            if spec.train:
                if chosen:
                    _check_rate(run, chosen, spec, changes.assignments)
                    _check_progress(session, actor, found, spec, chosen)
                environment["MUSTER_WORLDS"] = str(_worlds(session, actor, found, before, spec, chosen))
            if chosen and changes.checkpoint is not None:
                environment["MUSTER_CHECKPOINT"] = chosen.name
            job = submit(context, spec, changes.directory, f"run {run.name}", environment)
            return {
                **submission.answer(job),
                "run": run.name,
                "iteration": chosen.iteration if chosen else 0,
                "kind": spec.kind,
            }

    answer = with_store(reconciler, begin)
    reconciler.wake()
    return answer


def _answered(context: Context, run: FoundRun, saved: Sequence[Checkpoint]) -> dict[str, Any] | None:
    """The answer to an earlier call with the same idempotency key. Raises ClientError where that was for another run."""
    job = answered(context, run.name)
    if job is None:
        return None
    kind = "train" if (spec_of(context.session, context.actor, run) or {}).get("train") else "command"
    return {
        **submission.answer(job),
        "run": run.name,
        "iteration": saved[-1].iteration if saved else 0,
        "kind": kind,
    }


def last_metrics(run: Run) -> dict[str, Any] | None:
    """The newest record of the run's metrics."""
    try:
        newest = sampled(run, 2)
    except (DamagedFile, OSError):
        return None
    return newest[-1] if newest else None


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
    may_change = getattr(task_config(after.train.task), "may_change", ())
    was, wanted = (
        {**dict(train), "config": {key: value for key, value in (train.config or {}).items() if key not in may_change}}
        for train in (before.train, after.train)
    )
    if difference := first_difference(was, wanted, ("task", "algorithm", "seed", "config")):
        key, old, new = innermost(*difference)
        raise ClientError(
            f"run {run.name}: train.{key} is {_shown(old)} and can't become {_shown(new)}; start a new run for that: "
            f"muster clone {run.name} --name NEW begins one with its weights"
        )
    name = after.train.algorithm
    kind = ALGORITHMS.get(name)
    if difference := first_difference(before.train.given(), after.train.given(), fixed_settings(kind)):
        may = difference[0] not in fixed_settings(kind, of_clone=True)
        key, *values = innermost(*difference)
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
    asked = setting_at(override({}, assignments), f"train.{name}.{key}")  # whatever section the assignment gives whole
    if asked is None or (name == "ppo" and after.train.given().get("schedule") == "fixed"):
        return
    try:
        saved = chosen.manifest
    except DamagedCheckpoint:
        return  # the worker uses the one before
    rate = saved.get("learning_rate")
    if not isinstance(asked, int | float) or not isinstance(rate, int | float):
        return
    differs = setting_at(saved, f"train.{name}.{key}") != asked  # then it counts
    if not differs and not math.isclose(rate, asked, rel_tol=1e-6):  # a rate may be a float32
        raise ClientError(
            f"run {run.name}: train.{name}.{key} is {asked!r} already, so that the run would continue with "
            f"the rate of its checkpoint, which is {rate:.3g} now; set another value{hint}"
        )


_RATES = {"ppo": ("learning_rate", ", or train.ppo.schedule=fixed"), "rsl_rl": ("algorithm.learning_rate", "")}
"""Of each algorithm that adapts a learning rate: which setting is the first one, and what else helps who wants it back."""


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
    wanted = after.train.worlds * ranks
    changed = before.train.worlds != after.train.worlds
    if changed and chosen is None:  # no checkpoint holds worlds yet
        return wanted
    worlds = _worlds_of(session, actor, run, before, chosen)
    if changed and wanted != worlds:
        assert chosen is not None
        raise ClientError(
            f"run {run.name}: checkpoint {chosen.name} holds {counted(worlds, 'world')}, this job would have {wanted} "
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
        if chosen and isinstance(told := chosen.manifest.get("worlds"), int):
            return told
    except DamagedCheckpoint:
        pass
    if (newest := newest_job(session, actor, run)) and (given := newest.gang.options.worlds) is not None:
        return given
    return before.train.worlds * before.ranks_per_node * before.nodes.max


def newest_job(session: Session, actor: Actor, run: FoundRun) -> Job | None:
    return session.scalars(select(Job).where(*_of_run(actor, run)).order_by(Job.created_at.desc()).limit(1)).first()


def _of_run(actor: Actor, run: FoundRun) -> list[ColumnElement[bool]]:
    """Those of the run's jobs that the caller may see: a key with all queues may have continued it in another queue."""
    queues = actor.queues
    return [*jobs_of(run), *([] if queues is None else [Job.queue.in_(queues)])]


def _evaluated(run: Run) -> dict[str, dict[str, Any]]:
    """Of each checkpoint its evaluation in the worlds of its training; nothing where they can't be read."""
    try:
        return by_checkpoint(run)
    except OSError:
        return {}


def _best(checkpoints: Sequence[Checkpoint], evaluated: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """The best checkpoint by evaluations, where there is one to compare it with: ``RUN@best``."""
    best = best_evaluated(checkpoints, evaluated)
    if best is None or len(evaluated) < 2:
        return None
    mean = evaluated[best.name]["mean_return"]
    return {"checkpoint": best.name, "iteration": best.iteration, "mean": mean, "of": len(evaluated)}


def _automatic(session: Session, actor: Actor, run: FoundRun) -> dict[str, Any] | None:
    """The newest automatic evaluation of a training, how it is, and how many checkpoints that were due were passed over."""
    row = session.get(AutomaticEvaluation, run.name)
    training = session.get(Job, row.training) if row else None
    if row is None or (training is not None and is_of_earlier_run(training, run)):
        return None
    job = session.get(Job, row.job) if row.job else None
    job = job if job is not None and actor.may_see(job) else None  # it may be in a queue that the caller can't see
    return {
        "checkpoint": row.checkpoint,
        "iteration": int(row.checkpoint.partition("-")[0]) if row.checkpoint else None,
        "job": row.job,
        "status": job.status if job else None,
        "statusReason": job.status_reason if job else None,
        "passed": row.passed,
        "problem": row.problem,
    }
