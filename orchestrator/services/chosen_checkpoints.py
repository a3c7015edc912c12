"""What a request names in the store: a checkpoint, and things that a task's configuration names; checked before a job exists."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Literal

from orchestrator.domain.errors import ClientError
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import task_name
from shared_store.contract import plugins
from shared_store.contract.error_text import unknown_iteration
from shared_store.volume.checkpoints import (
    Checkpoint,
    DamagedCheckpoint,
    NewerFormat,
    best_checkpoint,
    list_checkpoints,
)
from shared_store.volume.layout import Run, Store
from shared_store.volume.run_settings import merged

CONFLICT = 409
"""The request is well formed, but conflicts with the present state."""


def choose(run: Run, requested: int | Literal["best", "latest"] | None) -> Checkpoint | None:
    """The requested checkpoint; None for the newest one of a run that has none. Raises ClientError where it does not exist."""
    checkpoints = list_checkpoints(run)
    known = [checkpoint.iteration for checkpoint in checkpoints]
    if requested in (None, "latest"):
        return checkpoints[-1] if checkpoints else None
    if requested == "best":
        chosen = best_checkpoint(run)
        problem = (
            f"run {run.name}: no checkpoint has a score yet, which is a mean over at least 100 episodes, and no two are evaluated; "
            f"name an iteration: {', '.join(map(str, known)) or 'none yet'}"
        )
    else:
        chosen = next((each for each in reversed(checkpoints) if each.iteration == requested), None)
        problem = unknown_iteration(run.name, requested, known)
    if chosen is None:
        raise ClientError(problem, 404)
    return chosen


def refusal(run: Run, chosen: Checkpoint, error: DamagedCheckpoint) -> ClientError:
    """The error of a checkpoint that can't be used."""
    if isinstance(error, NewerFormat):
        return ClientError(f"run {run.name}: {error}", CONFLICT)
    others = [str(each.iteration) for each in list_checkpoints(run) if each.name != chosen.name]
    return ClientError(f"run {run.name}: {error}; choose another ({', '.join(others) or 'there is none'})", CONFLICT)


def manifest_of(run: Run, chosen: Checkpoint) -> dict[str, Any]:
    """The manifest of a checkpoint. Raises ClientError where it can't be read."""
    try:
        return chosen.manifest
    except DamagedCheckpoint as error:
        raise refusal(run, chosen, error) from None


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
    requested, changes = section.get("checkpoint"), section.get("config") or {}
    if not (requested in (None, "best", "latest") or isinstance(requested, int)) or not isinstance(changes, dict):
        return None
    chosen = choose(run, requested)
    if chosen is None:
        raise ClientError(f"run {run.name} has no checkpoint yet; train it first", 404)
    facts = manifest_of(run, chosen)
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


def check_training(
    store: Store,
    spec: Mapping[str, Any] | None,
    read: Callable[[Hashable, Callable[[], None]], None] = lambda _, check: check(),
) -> None:
    """Raise ClientError where a training's configuration names something that the store does not have, or has damaged.

    ``read``: reads the store, as :meth:`.context.Context.read`. Raises what it raises.
    """
    train = (spec or {}).get("train")
    if not isinstance(train, Mapping) or not isinstance(task := train.get("task"), str):
        return
    kind, config = task_config(task), train.get("config")
    if kind is not None and isinstance(config, Mapping) and (named := tuple(kind.stored_names(config))):
        read(("names", task, named), partial(check_names, store, kind, config, lambda key: f"train.config.{key}"))


def check_names(store: Store, kind: Any, config: Mapping[str, Any], key_of: Callable[[str], str]) -> None:
    """Raise ClientError where a configuration names something that the store does not have, or has damaged.

    Args:
        kind: The configuration's class, a :class:`worker.settings.task.TaskConfig`.
        config: Some of its fields.
        key_of: From one of them to the job's key that gives it.
    """
    for key, name in kind.stored_names(config):
        if words := kind.missing(store, key, name):
            raise ClientError(f"{key_of(key)}: {words}")
