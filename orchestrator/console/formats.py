"""Formats of numbers, times and facts on the pages.

A job may write anything: where a number is expected, a value of another kind is shown as an empty text.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from markupsafe import Markup, escape

from shared_store.contract.error_text import counted
from shared_store.volume.metrics import finite

_UNITS = ((86400, "d"), (3600, "h"), (60, "min"))
_SPARK = (100.0, 24.0)
"""Width and height of a sparkline."""
_NODES = 16
"""Number of an attempt's nodes that are named."""


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


def moment(when: Any, unit: float = 1) -> str:
    """A Unix time in units of so many ms, for the attribute ``datetime`` of a ``<time>``; empty for anything else, and beyond all calendars."""
    try:
        known = finite(when)
        return "" if known is None else datetime.fromtimestamp(known * unit / 1000, UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError, OSError):  # what a file of the store says may be anything
        return ""


def age(when: Any, unit: float = 1) -> Markup:
    """How long a Unix time is past, in units of so many ms, as a ``<time>`` that ``static/times.js`` renews; empty for anything else."""
    if not (iso := moment(when, unit)):
        return Markup()
    return Markup(f'<time datetime="{iso}" data-since>{duration(time.time() - when * unit / 1000)}</time>')


def ran(facts: Mapping[str, Any]) -> Markup | str:
    """How long a job or an attempt has run, by its ``runsSince`` and ``ranSeconds``."""
    return age(facts["runsSince"]) if facts["runsSince"] else duration(facts["ranSeconds"])


def link(address: str, text: str) -> Markup:
    """A link to a page of the console."""
    return Markup(f'<a href="{escape(address)}">{escape(text)}</a>')


def count(number: Any) -> str:
    """A number in at most four digits: ``12``, ``3.46``, ``18.2 k``, ``1.07 M``; empty for a value other than a number."""
    value = finite(number)
    if value is None:
        return ""
    for size, unit in ((1e9, " G"), (1e6, " M"), (1e4, " k")):
        if abs(value) >= size:
            scaled = value / (1e3 if size == 1e4 else size)
            return f"{scaled:.{2 if abs(scaled) < 10 else 1 if abs(scaled) < 100 else 0}f}{unit}"
    return f"{value:.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.3g}"


def with_error(value: Any, error: Any) -> str:
    """A number and its standard error, where that is known."""
    shown, spread = count(value), count(error)
    return f"{shown} ± {spread}" if shown and spread else shown


def interval(result: Mapping[str, Any] | None) -> str:
    """The ``mean`` of an evaluation, and half of its 95 % interval where its ``high`` end is known."""
    mean, high = (finite((result or {}).get(each)) for each in ("mean", "high"))
    if mean is None:
        return ""
    return f"{mean:.2f} ± {high - mean:.2f}" if high is not None else f"{mean:.2f}"


def size(amount: Any) -> str:
    """Bytes: ``12 kB``, ``1.5 MiB``, ``3 GiB``; empty for a value other than a number."""
    known = finite(amount)
    if known is None:
        return ""
    if known < 2**20:
        return f"{known / 1000:.3g} kB" if known >= 1000 else f"{known:.0f} B"
    return f"{known / 2**30:.3g} GiB" if known >= 2**30 else f"{known / 2**20:.{1 if known < 2**27 else 0}f} MiB"


def amounts(held: Mapping[str, float]) -> str:
    """CPUs and GPUs, without those of which there are none."""
    named = ((held["cpus"], "CPU"), (held["gpus"], "GPU"))
    return ", ".join(f"{amount:g} {unit}{'s' if amount != 1 else ''}" for amount, unit in named if amount)


def spark(values: Sequence[float]) -> str:
    """Points of a ``<polyline>`` in a box of 100 × 24, the least value at its bottom; empty for fewer than two values."""
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    width, height, span = _SPARK[0] / (len(values) - 1), _SPARK[1] - 4, (high - low) or 1
    return " ".join(
        f"{i * width:.1f},{_SPARK[1] - 2 - (each - low) / span * height:.1f}" for i, each in enumerate(values)
    )


def nodes(found: Sequence[Mapping[str, Any]]) -> str:
    """The host of each of an attempt's nodes, and how it ended."""
    named = []
    for node in found[:_NODES]:
        gpus = f", {counted(len(node['gpus']), 'GPU')}" if node["gpus"] else ""
        ending = ""
        if not node["running"]:
            code = node.get("exitCode")
            reason = (node.get("reason") or "").removeprefix(f"exit {code}, ")
            ending = f" (exit {'?' if code is None else code}{f': {reason}' if reason else ''})"
        named.append(f"node {node['index']} on {node['host']}{gpus}{ending}")
    if len(found) > _NODES:
        named.append(f"and {counted(len(found) - _NODES, 'more node')}")
    return "; ".join(named)


def cost(attempt: Mapping[str, Any], saves: bool) -> str:
    """The time on GPUs of an attempt, or on CPUs where it has none; ``saves``: with what was lost since its last checkpoint."""
    kind = "gpu" if attempt["gpuSeconds"] else "cpu"
    used, lost = attempt[f"{kind}Seconds"], attempt[f"wasted{kind.title()}Seconds"]
    if not used:
        return ""
    return f"{duration(used)} of {kind.upper()}s" + (f", {duration(lost)} lost" if saves and lost >= 1 else "")
