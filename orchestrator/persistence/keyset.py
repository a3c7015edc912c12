"""Keyset pagination: pages by a place in an order, not by a number. None repeats or skips a row, and each costs the same."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, and_, or_
from sqlalchemy.orm import InstrumentedAttribute


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
