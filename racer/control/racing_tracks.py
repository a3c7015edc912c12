"""The tracks that a racer's job names: there before the job is."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Any

from orchestrator.domain.errors import ClientError
from orchestrator.spec.settings import task_config
from racer.store.leagues import LeagueError, digest_of_track
from shared_store.volume.layout import Store


def check_tracks(
    store: Store,
    spec: Mapping[str, Any] | None,
    read: Callable[[Hashable, Callable[[], None]], None] = lambda _, check: check(),
) -> None:
    """Raise ClientError where a training of an installed racer's task names a track that does not exist or is damaged.

    ``read``: reads the store, as :meth:`.context.Context.read`. Raises what it raises.
    """
    if (named := _tracks(spec)) is not None:
        read(("tracks", str(named)), partial(check_names, store, named, "train.config.track"))


def _tracks(spec: Mapping[str, Any] | None) -> Any:
    train = (spec or {}).get("train")
    task = train.get("task") if isinstance(train, Mapping) else None
    if not isinstance(train, Mapping) or not isinstance(task, str):
        return None
    kind, config = task_config(task), train.get("config")
    return config.get("track") if kind is not None and kind.races and isinstance(config, Mapping) else None


def check_names(store: Store, named: Any, key: str) -> None:
    """Raise ClientError where a track does not exist or is damaged.

    Args:
        store: The store that holds the tracks.
        named: One name, or a list of them; anything else is the schema's matter.
        key: Of the spec, which names them.
    """
    for name in [named] if isinstance(named, str) else named if isinstance(named, list | tuple) else []:
        if isinstance(name, str):
            try:
                digest_of_track(store, name)
            except LeagueError as error:
                raise ClientError(f"{key}: {error}") from None
