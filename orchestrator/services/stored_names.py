"""Names of what the store holds, in a task's configuration: there before the job is."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Any

from orchestrator.domain.errors import ClientError
from orchestrator.spec.settings import task_config
from shared_store.volume.layout import Store


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
        store: The store.
        kind: The configuration's class, a :class:`worker.settings.task.TaskConfig`.
        config: Some of its fields.
        key_of: From one of them to the job's key that gives it.
    """
    for key, name in kind.stored_names(config):
        if words := kind.missing(store, key, name):
            raise ClientError(f"{key_of(key)}: {words}")
