"""The training of a job: task, algorithm and all settings, resolved once, before any world is built.

The settings of a run that began earlier which no job sets stay as they were then, whatever the defaults are now.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.files import DamagedFile
from shared_store.volume.initial_weights import named_parent
from shared_store.volume.run_settings import fixed_settings, setting_at
from worker.learning import algorithms
from worker.learning.algorithm import Algorithm
from worker.learning.algorithms import refusal, section_of
from worker.learning.distributed import Gang
from worker.learning.job import Job, configure
from worker.settings.errors import UserError

if TYPE_CHECKING:
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task


@dataclass(frozen=True)
class Training:
    """A job's ``train`` and ``checkpoint`` sections with all defaults filled in."""

    job: Job
    task_type: type[Task]
    config: TaskConfig
    """The task's configuration."""
    algorithm: str
    """Name of the algorithm in the job's YAML."""
    algorithm_type: type[Algorithm]
    settings: Any
    """Settings of the algorithm, of its ``config_type``."""
    iterations: int
    """Iteration at which training ends."""
    seed: int
    save_every: int | str
    """Iterations between two saves, or ``auto``."""
    keep: int
    """Number of checkpoints to keep."""

    @classmethod
    def of(cls, job: Job, task_type: type[Task]) -> Training:
        """Raises UserError that names the wrong key."""
        config, name = configure(task_type, job.section), job.section.get("algorithm", algorithms.DEFAULT)
        algorithm = algorithms.find_algorithm(name)
        checkpoints = job.spec.get("checkpoint") or {}
        return cls(
            job,
            task_type,
            config,
            algorithm=name,
            algorithm_type=algorithm,
            settings=algorithms.settings(algorithm, name, config, job.section),
            iterations=job.setting("iterations", 100),
            seed=job.setting("seed", 0, least=0),
            save_every=checkpoints.get("every", 25),
            keep=int(checkpoints.get("keep", 5)),
        )


def as_started(training: Training, gang: Gang) -> tuple[Training, str]:
    """``training`` with the settings of the run's newest checkpoint where neither its job nor this one sets them, and a line about them.

    Settings that did not exist then have the values that compute the same: those in ``before`` of their class. A clone takes over what
    its weights depend on, and is otherwise a new run. All ranks call it.

    Raises:
        UserError: This job's settings do not fit those.
    """
    kept = json.loads(gang.broadcast_text(json.dumps(_kept(training)) if gang.is_main else None) or "{}")
    if not kept:
        return training, ""
    now = dataclasses.asdict(training.settings)
    try:
        settings = dataclasses.replace(training.settings, **kept)
    except (TypeError, ValueError) as error:
        raise UserError(refusal(section_of(training.algorithm), error)) from error
    listed = ", ".join(f"{name} {_shown(value)} (now {_shown(now[name])})" for name, value in kept.items())
    return (
        dataclasses.replace(training, settings=settings),
        f"settings as when the run began, since the job sets no others: {listed}",
    )


def _kept(training: Training) -> dict[str, Any]:
    """The settings that differ from those of today and that nobody set, by name; their values are as in JSON."""
    found = _checkpoint(training.job)
    saved = found[0].manifest if found else {}
    if not found or saved.get("algorithm") != training.algorithm:
        return {}
    kind: Any = type(training.settings)
    key = f"train.{section_of(training.algorithm)}"
    set_by_job = {*(setting_at(saved, key) or {}), *(training.job.section.get(section_of(training.algorithm)) or {})}
    then = {**getattr(kind, "before", {}), **(saved.get("settings") or {})}
    now = json.loads(json.dumps(dataclasses.asdict(training.settings)))
    names = fixed_settings(kind, saved.get("settings") or {}, of_clone=True) if found[1] else now
    return {
        name: then[name] for name in names if name not in set_by_job and name in then and then[name] != now.get(name)
    }


def _checkpoint(job: Job) -> tuple[Checkpoint, bool] | None:
    """The checkpoint from which the job will go on, and whether it is a clone's first; None for a new run.

    A damaged one is left out here: whether a checkpoint can be used is decided where it is loaded.
    """
    own = list_checkpoints(job.run)
    chosen = [each for each in own if each.name == job.checkpoint]
    if not chosen or own[-1].epoch >= job.job_epoch:
        chosen = list(reversed(own))
    for checkpoint in chosen:
        if _is_readable(checkpoint):
            return checkpoint, False
    try:
        parent = named_parent(job.run)
    except (DamagedCheckpoint, DamagedFile, OSError):
        return None
    return (parent, True) if parent and _is_readable(parent) else None


def _is_readable(checkpoint: Checkpoint) -> bool:
    try:
        return isinstance(checkpoint.manifest, Mapping)
    except DamagedCheckpoint:
        return False


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
