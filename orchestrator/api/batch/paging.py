"""Paging in AWS's operations: ``maxResults`` and ``nextToken``."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Select
from sqlalchemy.orm import InstrumentedAttribute, Session

from orchestrator.domain.errors import ClientError
from orchestrator.persistence.keyset import behind


def page_size(request: dict[str, Any], most: int) -> int:
    """``maxResults``, at most ``most``."""
    return max(1, min(request.get("maxResults") or most, most))


def page(
    session: Session,
    query: Select[Any],
    request: dict[str, Any],
    *keys: InstrumentedAttribute[Any],
    descending: Sequence[bool] = (False, False),
    most: int = 100,
) -> tuple[list[Any], dict[str, str]]:
    """The rows behind ``nextToken``, and the token of the next page where there is one.

    Args:
        query: Rows, ordered by ``keys``.
        request: Holds ``maxResults`` and ``nextToken``.
        keys: The columns of the order; together they are unique.
        descending: Of each key.
        most: Rows a page.
    """
    size = page_size(request, most)
    if token := request.get("nextToken"):
        values = decode(token, [key.type.python_type for key in keys])
        query = query.where(behind(keys, values, descending))
    rows = list(session.scalars(query.limit(size + 1)))
    if len(rows) <= size:
        return rows, {}
    last = rows[size - 1]
    return rows[:size], {"nextToken": encode([getattr(last, key.key) for key in keys])}


def encode(values: Sequence[Any]) -> str:
    return base64.urlsafe_b64encode(json.dumps(values).encode()).decode()


def decode(token: str, kinds: Sequence[type]) -> list[Any]:
    """The position in a token: one value of each kind (``int`` or ``str``). Raises ClientError for one that was not given out."""
    try:
        values = json.loads(base64.b64decode(token.encode(), altchars=b"-_", validate=True))
        if isinstance(values, list) and [type(value) for value in values] == list(kinds):
            text = json.dumps(values, ensure_ascii=False)
            text.encode()  # no database takes half of a character
            if "\\u0000" not in text and all(abs(value) < 2**63 for value in values if isinstance(value, int)):
                return values
    except (ValueError, RecursionError):
        pass
    raise ClientError(f"nextToken {token[:100]!r} is not one that was given out")
