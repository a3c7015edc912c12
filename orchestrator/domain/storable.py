"""Storable documents: what a spec must not hold, since JSON can't carry it, or no answer could show it again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from shared_store.contract.error_text import kind_of, shown

DEEPEST_SPEC = 100
"""Levels of lists and mappings in a spec. A deeper one could be stored, but no answer could show it."""
Problem = tuple[tuple[str | int, ...], str]
"""Keys to a value of a document, and what is wrong with it in one line."""


def _values(document: object) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Every value of a document with the keys that lead to it, the outer ones first."""
    left: list[tuple[tuple[str | int, ...], Any]] = [((), document)]
    while left:
        path, value = left.pop()
        yield path, value
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        left += [((*path, key), each) for key, each in items]


def not_finite(document: object) -> Problem | None:
    """The spec travels as JSON, which has no infinity."""
    found = (
        (path, value) for path, value in _values(document) if isinstance(value, float) and not math.isfinite(value)
    )
    return next(((path, f"expected a finite number, found {kind_of(value)}") for path, value in found), None)


def not_storable(document: object) -> Problem | None:
    """What could be stored but never shown again: half of a character, and more levels than an answer may have."""
    for path, value in _values(document):
        if len(path) >= DEEPEST_SPEC:
            return path[:1], f"nested deeper than {DEEPEST_SPEC} levels"
        for text in value if isinstance(value, dict) else (value,):
            if isinstance(text, str) and not text.isascii() and any("\ud800" <= each <= "\udfff" for each in text):
                return path, f"half of a character (a lone surrogate) in {shown(text)}; write whole ones"
    return None
