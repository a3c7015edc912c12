"""Keyset pagination: pages by a place in an order, not by a number. None repeats or skips a row, and each costs the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

from sqlalchemy import ColumnElement, and_, or_
from sqlalchemy.orm import InstrumentedAttribute

from orchestrator.domain.errors import RequestError


@dataclass(frozen=True)
class Cursor:
    """A place in a list of jobs that is ordered by a time and their ids; by default before all of them."""

    at: int = -1
    """Unix time [ms]."""
    id: str = ""

    @classmethod
    def read(cls, text: str) -> Self:
        """What :meth:`__str__` has written. Raises RequestError."""
        at, _, job = text.partition("-")
        is_time = at.isascii() and at.isdecimal() and len(at) <= 15
        if not (is_time and job and job.isascii() and job.isprintable()):
            raise RequestError(f"{text[:100]!r} is not a place in the list of jobs; leave it out to begin anew")
        return cls(int(at), job)

    def __str__(self) -> str:
        return f"{self.at}-{self.id}"


def behind(
    keys: Sequence[InstrumentedAttribute[Any]], values: Sequence[Any], descending: Sequence[bool]
) -> ColumnElement[bool]:
    """The rows that follow a place in an order.

    Args:
        keys: The columns of the order; together they are unique.
        values: The place: a value of each.
        descending: Of each key.
    """
    found = []
    for index, (key, value) in enumerate(zip(keys, values, strict=True)):
        same = [keys[i] == values[i] for i in range(index)]
        found.append(and_(*same, key < value if descending[index] else key > value))
    # a bound of its own for the first key: no database enters an index by the alternatives
    return and_(keys[0] <= values[0] if descending[0] else keys[0] >= values[0], or_(*found))
