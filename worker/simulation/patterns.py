"""Patterns of joint, body, site and geom names in task declarations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TypeVar

from shared_store.contract.error_text import nearest

Value = TypeVar("Value")
FLOORS = ("floor", "ground")
"""Names of floors in robot files."""


def find(names: Sequence[str], patterns: str | Iterable[str], what: str) -> list[int]:
    """The names that match any of the patterns.

    Args:
        names: All names, in the order of the model.
        patterns: One pattern or several, as of file names (``*``, ``?``, ``[ab]``); a whole name matches itself.
        what: Kind and owner of the names, for the error: ``"joint of robot"``.

    Returns:
        Indices into ``names``, ascending.

    Raises:
        ValueError: A pattern matches nothing, or there is no pattern.
    """
    chosen = [patterns] if isinstance(patterns, str) else list(patterns)
    if not chosen:
        raise ValueError(f"no pattern for a {what} was given; available: {', '.join(names) or 'none'}")
    found: set[int] = set()
    for pattern in chosen:
        matching = {index for index, name in enumerate(names) if name == pattern or fnmatchcase(name, pattern)}
        if not matching:
            raise ValueError(f"no {what} matches {pattern!r}; {_existing_names(pattern, names)}")
        found |= matching
    return sorted(found)


def check_ignored(names: Sequence[str], patterns: Iterable[str], what: str) -> None:
    """Check the patterns of what a robot leaves out; those of floors, which it leaves out by default, need match nothing.

    Raises:
        ValueError: Another pattern matches nothing.
    """
    if others := [pattern for pattern in patterns if pattern not in FLOORS]:
        find(names, others, what)


def resolve(names: Sequence[str], values: Value | Mapping[str, Value], what: str) -> list[Value | None]:
    """A value for each name; the first pattern that matches a name wins.

    Args:
        names: All names, in the order of the model.
        values: One value for all names, or values by pattern.
        what: As for :func:`find`.

    Returns:
        One value per name, None where no pattern matches.

    Raises:
        ValueError: A pattern matches nothing.
    """
    if not isinstance(values, Mapping):
        return [values] * len(names)
    resolved: list[Value | None] = [None] * len(names)
    for pattern, value in reversed(list(values.items())):
        for index in find(names, pattern, what):
            resolved[index] = value
    return resolved


def _existing_names(pattern: str, names: Sequence[str]) -> str:
    everything = f"available: {', '.join(names) or 'none'}"
    simple = pattern.strip("^$").replace(".*", "*")
    if simple != pattern and any(fnmatchcase(name, simple) for name in names):
        return f"patterns are like those of file names, not regular expressions: did you mean {simple!r}? {everything}"
    near = nearest(pattern.replace("*", "").replace("?", ""), names, otherwise=" ")
    return f"{near} {everything}".strip()
