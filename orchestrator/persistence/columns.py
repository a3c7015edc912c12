"""Types of columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import String
from sqlalchemy.types import TypeDecorator

from orchestrator.domain.excerpts import LONGEST_REASON, excerpt


class Names(TypeDecorator[tuple[str, ...]]):
    """Names of devices, which have no comma, as the text ``0,1``; an empty text is none."""

    impl = String
    cache_ok = True

    def process_bind_param(self, value: Sequence[str] | None, dialect: Any) -> str | None:
        return None if value is None else ",".join(value)

    def process_result_value(self, value: Any, dialect: Any) -> tuple[str, ...] | None:
        return None if value is None else tuple(value.split(",")) if value else ()


def written_out(_row: object, _column: str, text: str | None) -> str | None:
    """For ``validates``: the text as a column can hold it."""
    return None if text is None else storable(text)


def bounded(_row: object, _column: str, text: str | None) -> str | None:
    """The same for a reason, in at most :data:`LONGEST_REASON` characters."""
    return None if text is None else excerpt(storable(text), LONGEST_REASON)


def storable(text: str) -> str:
    """The text with zero bytes and halves of characters, which a column can't hold, written out."""
    return text.replace("\0", "\\x00").encode(errors="backslashreplace").decode()
