"""Runs as they are shown: their facts in the store and in the database."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import ObservedRun, facts_of
from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from orchestrator.persistence.batch_models import Job, RunRecord
from orchestrator.persistence.own_models import AutomaticEvaluation
from orchestrator.persistence.ownership import FoundRun, is_of_earlier_run, jobs_of, owner_of
from orchestrator.services.context import visible_runs
from orchestrator.services.damaged_rows import DamagedRow, reading
from orchestrator.services.permissions import Actor
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, best_evaluated, list_checkpoints
from shared_store.volume.contents import is_archived
from shared_store.volume.evaluations import by_checkpoint
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run
from shared_store.volume.metrics import sampled

_KEPT = 600.0
"""Seconds for which the parent of a run is not read again: it changes only where the run is replaced by another of its name."""


def list_runs(
    controller: Controller, actor: Actor, after: str, most: int, search: str = "", archived: bool = False
) -> list[dict[str, Any]]:
    """The first ``most`` runs behind the name ``after``, with ``search`` in their names, that the caller may see: those that are archived, or not.

    One that can't be read has a ``problem`` instead of its facts.
    """
    stored: list[StoredRun | dict[str, Any]] = []
    for run in visible_runs(controller, actor, after, most, search.strip(), lambda run: is_archived(run) == archived):
        try:
            stored.append(stored_run(run))
        except (DamagedFile, OSError) as error:
            problem = excerpt(" ".join(str(error).split()), LONGEST_REASON)
            stored.append({"run": run.name, "path": str(run.path), "problem": problem})
    names = [each.found.name for each in stored if isinstance(each, StoredRun)]
    with controller.database.session() as session:
        # one query instead of one a run: the session looks here first
        _known = session.scalars(select(RunRecord).where(RunRecord.name.in_(names))).all()
        return [described(session, actor, each) if isinstance(each, StoredRun) else each for each in stored]


def describe_run(controller: Controller, actor: Actor, run: Run) -> dict[str, Any]:
    """Facts of a run: its jobs, its newest checkpoint, and where its results lie. Raises DamagedFile, OSError."""
    stored = stored_run(run)
    with controller.database.session() as session:
        return described(session, actor, stored)


@dataclass(frozen=True)
class StoredRun:
    """What the store has of a run."""

    found: ObservedRun
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


def last_metrics(run: Run) -> dict[str, Any] | None:
    """The newest record of the run's metrics."""
    try:
        newest = sampled(run, 2)
    except (DamagedFile, OSError):
        return None
    return newest[-1] if newest else None


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


def clones_of(controller: Controller, actor: Actor, run: Run) -> list[str]:
    """The runs that began with weights of ``run`` and that the caller may see, by name."""
    return [each.name for each in visible_runs(controller, actor) if _parents.of(each) == run.name]


class _Parents:
    """The parent of each run, read once in ten minutes. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[str, tuple[float, str | None]] = {}

    def of(self, run: Run) -> str | None:
        """The name of a run's parent; None where it has none, or can't be read."""
        key, now = str(run.path), time.monotonic()
        with self._lock:
            known = self._known.get(key)
        if known is not None and now - known[0] < _KEPT:
            return known[1]
        try:
            parent = ((run.description() or {}).get("parent") or {}).get("run")
        except (DamagedFile, OSError):
            return None
        parent = parent if isinstance(parent, str) else None
        with self._lock:
            self._known[key] = now, parent
        return parent


_parents = _Parents()
