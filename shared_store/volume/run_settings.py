"""Compare the settings of two jobs, for those that a resumed run or a clone must keep; and change some of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from shared_store.volume.texts import is_file


def setting_at(settings: Any, key: str) -> Any:
    """The setting ``key``, in which a dot leads into a section; None if it is missing or an empty section."""
    for part in key.split("."):
        settings = settings.get(part) if isinstance(settings, Mapping) else None
    return None if settings == {} else settings


def first_difference(old: Any, new: Any, keys: Iterable[str]) -> tuple[str, Any, Any] | None:
    """The first of ``keys`` whose setting differs, with both values; None if all are equal."""
    pairs = ((key, setting_at(old, key), setting_at(new, key)) for key in keys)
    return next((pair for pair in pairs if pair[1] != pair[2]), None)


def innermost(key: str, old: Any, new: Any) -> tuple[str, Any, Any]:
    """The first part of a setting that differs, with both values: in sections, the first such key."""
    while isinstance(old, Mapping) and isinstance(new, Mapping):
        part = next(name for name in {**old, **new} if old.get(name) != new.get(name))
        key, old, new = f"{key}.{part}", old.get(part), new.get(part)
    return key, old, new


def fixed_settings(kind: Any, saved: Any = None, *, of_clone: bool = False) -> list[str]:
    """The settings that a run can't change once it has a checkpoint, from the class of an algorithm's settings.

    Args:
        kind: That class; None if unknown.
        saved: The settings in a checkpoint; those that an older Muster lacked can't be compared.
        of_clone: Leave out those that a clone may change.
    """
    may_change = getattr(kind, "clone_may_change", ()) if of_clone else ()
    fixed = [key for key in getattr(kind, "fixed", ()) if key not in may_change]
    return fixed if saved is None else [key for key in fixed if key.partition(".")[0] in saved]


def changed_task(kind: Any, old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, Any, Any] | None:
    """The first of task, algorithm, seed and task's configuration that differs, which a run keeps: its innermost key, and both values.

    Args:
        kind: Class of the task's configuration, which names the fields that may change; None if unknown.
        old: Section ``train`` of the run.
        new: That of the job that would continue it.
    """
    may_change = getattr(kind, "may_change", ())
    kept = [
        {**train, "config": {key: value for key, value in (train.get("config") or {}).items() if key not in may_change}}
        for train in (old, new)
    ]
    difference = first_difference(kept[0], kept[1], ("task", "algorithm", "seed", "config"))
    return None if difference is None else innermost(*difference)


def changed_setting(
    kind: Any, old: Any, new: Any, saved: Any = None, *, of_clone: bool = False
) -> tuple[str, Any, Any, bool] | None:
    """The first setting of an algorithm that differs although a run has to keep it.

    Args:
        kind: Class of the settings.
        old: The run's.
        new: Those of the job that would continue it, or of the clone.
        saved: As of :func:`fixed_settings`.
        of_clone: Whether that job begins a clone.

    Returns:
        The innermost key, both values, and whether a clone may change the setting.
    """
    difference = first_difference(old, new, fixed_settings(kind, saved, of_clone=of_clone))
    return (
        None
        if difference is None
        else (*innermost(*difference), difference[0] in getattr(kind, "clone_may_change", ()))
    )


def merged(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``settings`` with the changes: sections are merged key by key; other values, the contents of files, and sections that become empty,
    are replaced."""
    result = dict(settings)
    for key, value in changes.items():
        old = result.get(key)
        if value and isinstance(old, Mapping) and isinstance(value, Mapping) and not is_file(value):
            value = merged(old, value)
        result[key] = value
    return result
