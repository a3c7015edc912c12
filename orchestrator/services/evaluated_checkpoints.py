"""Checks of the checkpoint that a job evaluates, exports or shows, before the job exists."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from orchestrator.domain.errors import ClientError
from orchestrator.services.chosen_checkpoints import choose, refusal
from orchestrator.services.stored_names import check_names
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import task_name
from shared_store.contract import plugins
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.layout import Run, Store
from shared_store.volume.run_settings import merged


def check_task(run: Run) -> None:
    """Raise ClientError where the task of a run's policy is not installed here, as its submission and its resuming would."""
    with suppress(DamagedCheckpoint):  # which the job that reads it names
        checkpoints = list_checkpoints(run)
        task = checkpoints[-1].manifest.get("task") if checkpoints else None
        if isinstance(task, str):
            try:
                task_name(task)
            except ValueError as error:
                raise ClientError(f"run {run.name}: train.task: {error}") from None


def check_evaluation(store: Store, run: Run, spec: Mapping[str, Any], key: str = "evaluate") -> Checkpoint | None:
    """The checkpoint that a section of a spec evaluates; None where the section is none, which the rank refuses.

    Raises ClientError: there is no such checkpoint, it can't be read, the section's rules are not for its task, or the task refuses
    the changes, or names something that the store does not have.

    ``key``: of the section, one of :func:`shared_store.contract.plugins.evaluating`.
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
    rules = plugins.rules_of(key)
    if rules:
        if kind is not None and (words := rules.refusal(kind)):
            raise ClientError(f"{key}: run {run.name} trained {task}, {words}")
        changes = rules.changes(section)

    def named(path: tuple[str | int, ...]) -> str:
        return rules.key_of(section, path) if rules else ".".join(map(str, (key, "config", *path)))

    if changes and kind is not None:
        if problem := kind.problem_with(merged(before if isinstance(before, dict) else {}, changes)):
            path, words = problem
            raise ClientError(f"{named(path)}: {words}")
        check_names(store, kind, changes, lambda each: named((each,)))
    return chosen
