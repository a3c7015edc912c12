"""Formats of numbers, times and attributes on the pages. A job may write anything: a value other than a number is shown as an empty text."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from markupsafe import Markup, escape

from shared_store.volume.metrics import finite

_UNITS = ((86400, "d"), (3600, "h"), (60, "min"))
_SPARK = (100.0, 24.0)
"""Width and height of a sparkline."""


def duration(seconds: Any) -> str:
    """``4 s``, ``12 min``, ``3 h 5 min``, ``2 d 4 h``; empty for a value other than a number."""
    known = finite(seconds)
    if known is None:
        return ""
    left = max(0, int(known))
    if left < 60:
        return f"{left} s"
    parts: list[str] = []
    for size, unit in _UNITS:
        amount, left = divmod(left, size)
        if amount or parts:
            parts.append(f"{amount} {unit}")
    return " ".join(part for part in parts[:2] if not part.startswith("0 "))


def ago(moment: int | None) -> str:
    """The time since a moment, a Unix time [ms]; empty for None."""
    return "" if moment is None else duration(time.time() - moment / 1000)


def moment(when: int | float | None) -> str:
    """Unix time [ms] for the attribute ``datetime`` of a ``<time>``; empty for None, and beyond all calendars."""
    try:
        return "" if when is None else datetime.fromtimestamp(when / 1000, UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError, OSError):  # what a file of the store says may be anything
        return ""


def since(iso: str) -> str:
    """:func:`ago` for a text of :func:`moment`."""
    return ago(int(datetime.fromisoformat(iso).timestamp() * 1000)) if iso else ""


def count(given: Any) -> str:
    """A number in at most four digits: ``12``, ``3.46``, ``18.2 k``, ``1.07 M``; empty for a value other than a number."""
    value = finite(given)
    if value is None:
        return ""
    for size, unit in ((1e9, " G"), (1e6, " M"), (1e4, " k")):
        if abs(value) >= size:
            scaled = value / (1e3 if size == 1e4 else size)
            return f"{scaled:.{2 if abs(scaled) < 10 else 1 if abs(scaled) < 100 else 0}f}{unit}"
    return f"{value:.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.3g}"


def spark(values: Sequence[float]) -> str:
    """Points of a ``<polyline>`` in a box of 100 × 24, the least value at its bottom; empty for fewer than two values."""
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    width, height, span = _SPARK[0] / (len(values) - 1), _SPARK[1] - 4, (high - low) or 1
    return " ".join(
        f"{i * width:.1f},{_SPARK[1] - 2 - (each - low) / span * height:.1f}" for i, each in enumerate(values)
    )


def bound(row: Mapping[str, Any], **targets: str) -> Markup:
    """Attributes of an element that shows fields of a row: their present values, and which ones a script renews.

    ``bound(row, href="link", text="name")``: the attribute ``href`` has the field ``link``; the text, which the template writes itself,
    is the field ``name``. ``hidden`` hides the element while its field is empty; ``state`` is ``data-state``.
    """
    names = " ".join(f"{target}:{field}" for target, field in targets.items())
    found = [
        f'data-bind="{escape(names)}"'
    ]  # the longest part of a large page: Markup's own format() takes thrice the time
    for target, field in targets.items():
        value = row.get(field)
        if target == "hidden":
            found += [] if value else ["hidden"]
        elif target != "text" and value not in (None, ""):
            found.append(f'{"data-state" if target == "state" else escape(target)}="{escape(value)}"')
    return Markup(" ".join(found))
