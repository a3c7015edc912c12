"""Types of columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import String
from sqlalchemy.types import TypeDecorator


class Names(TypeDecorator[tuple[str, ...]]):
    """Names of devices, which have no comma, as the text ``0,1``; an empty text is none."""

    impl = String
    cache_ok = True

    def process_bind_param(self, value: Sequence[str] | None, dialect: Any) -> str | None:
        return None if value is None else ",".join(value)

    def process_result_value(self, value: Any, dialect: Any) -> tuple[str, ...] | None:
        return None if value is None else tuple(value.split(",")) if value else ()


def storable(text: str) -> str:
    """The text with zero bytes and halves of characters, which a column can't hold, written out."""
    return text.replace("\0", "\\x00").encode(errors="backslashreplace").decode()
