"""Amounts with a unit, such as ``90d`` and ``64MiB``."""

from __future__ import annotations

import re
from collections.abc import Mapping

SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}
BYTES = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


def amount(text: str, units: Mapping[str, int], expected: str) -> float:
    """The amount in the unit of which ``units`` counts. Raises ValueError, which says what was ``expected``."""
    match = re.fullmatch(rf"(\d+(?:\.\d+)?)\s*({'|'.join(units)})", text.strip())
    if match is None:
        raise ValueError(f"expected {expected}")
    return float(match[1]) * units[match[2]]
