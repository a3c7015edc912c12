"""The settings of a run that began earlier: what its jobs do not set stays as it was then, whatever the defaults are now."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.files import DamagedFile
from shared_store.volume.initial_weights import named_parent
from shared_store.volume.run_settings import fixed_settings, setting_at
from worker.learning.algorithms import refusal, section_of
from worker.learning.distributed import Gang
from worker.learning.job import Job
from worker.learning.training import Training
from worker.settings.errors import UserError


def as_begun(training: Training, gang: Gang) -> tuple[Training, str]:
    """``training`` with the settings of the run's newest checkpoint where neither its job nor this one sets them, and a line about them.

    Settings that did not exist then have the values that compute the same: those in ``before`` of their class. A clone takes over what
    its weights depend on, and is otherwise a new run. All ranks call it.

    Raises:
        UserError: This job's settings do not fit those.
    """
    kept = json.loads(gang.tell(json.dumps(_kept(training)) if gang.is_main else None) or "{}")
    if not kept:
        return training, ""
    now = dataclasses.asdict(training.settings)
    try:
        settings = type(training.settings)(**{**_fields(training.settings), **kept})
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
    there = found[0].manifest if found else {}
    if not found or there.get("algorithm") != training.algorithm:
        return {}
    kind: Any = type(training.settings)
    key = f"train.{section_of(training.algorithm)}"
    set_by_job = {*(setting_at(there, key) or {}), *(training.job.section.get(section_of(training.algorithm)) or {})}
    then = {**getattr(kind, "before", {}), **(there.get("settings") or {})}
    now = json.loads(json.dumps(dataclasses.asdict(training.settings)))
    names = fixed_settings(kind, there.get("settings") or {}, of_clone=True) if found[1] else now
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


def _fields(settings: Any) -> dict[str, Any]:
    return {item.name: getattr(settings, item.name) for item in dataclasses.fields(settings) if item.init}


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
