"""Checks of the run of an evaluation or a race, before its job exists."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from orchestrator.domain.errors import ClientError
from orchestrator.services.chosen_checkpoints import choose, refusal
from orchestrator.spec.settings import task_config
from racer.control.racing_tracks import check_names
from racer.store.races import NO_RACER, key_of, race_changes
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint
from shared_store.volume.layout import Run, Store
from shared_store.volume.run_settings import merged


def check_evaluation(store: Store, run: Run, spec: Mapping[str, Any], key: str = "evaluate") -> Checkpoint | None:
    """The checkpoint that the section ``evaluate`` or ``race`` of a spec means; None where the section is none, which the rank refuses.

    Raises ClientError: there is no such checkpoint, it can't be read, its task drives no laps of a race, refuses the changes, or
    has no such track.
    """
    section = spec.get(key)
    if not isinstance(section, dict):
        return None
    wanted, changes = section.get("checkpoint"), section.get("config") or {}
    if not (wanted in (None, "best", "latest") or isinstance(wanted, int)) or not isinstance(changes, dict):
        return None
    chosen = choose(run, wanted)
    if chosen is None:
        raise ClientError(f"run {run.name} has no checkpoint yet; train it first", 404)
    try:
        facts = chosen.manifest
    except DamagedCheckpoint as error:
        raise refusal(run, chosen, error) from None
    task, trained = facts.get("task"), facts.get("train")
    kind = task_config(task) if isinstance(task, str) else None
    before = trained.get("config") if isinstance(trained, dict) else None
    if key == "race":
        if kind is not None and not kind.races:
            raise ClientError(f"race: run {run.name} trained {task}, {NO_RACER}")
        changes = race_changes(section)
    if changes and kind is not None:
        problem = kind.problem_with(merged(before if isinstance(before, dict) else {}, changes))
        if problem:
            path, words = problem
            named = key_of(section, path) if key == "race" else ".".join(map(str, ("evaluate", "config", *path)))
            raise ClientError(f"{named}: {words}")
        if kind.races:
            check_names(store, changes.get("track"), "race.track" if section.get("track") else f"{key}.config.track")
    return chosen
