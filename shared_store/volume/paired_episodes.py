"""The difference between two policies that played the same episodes: the same worlds, from the same starts.

Student (1908), "The probable error of a mean", second example: the mean of the differences d of the pairs, with its interval
mean(d) ∓ t(n - 1) · s(d) / √n. The difficulty of an episode affects both of a pair, and cancels in their difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

LEVEL = 0.95


def are_paired(new: Mapping[str, Any], old: Mapping[str, Any]) -> bool:
    """Whether two evaluations, by their summaries, played the same episodes, as far as both went.

    Episodes of the same number have the same world, so a shorter evaluation's episodes are the first of a longer one's. An evaluation
    at the end of a training has no seed, and uses the training's worlds.
    """
    same = all(new.get(key) == old.get(key) for key in ("seed", "task"))
    return same and (new.get("config") or None) == (old.get("config") or None) and isinstance(new.get("seed"), int)


def read_returns(table: Path) -> list[float]:
    """The returns in an evaluation's Parquet table, by episode number.

    Raises OSError, ValueError for any other table, ImportError without pyarrow.
    """
    import pyarrow.parquet

    try:
        columns = pyarrow.parquet.read_table(table, columns=["episode", "return"])
        numbers: list[int] = columns["episode"].to_pylist()
        returns: list[float] = columns["return"].to_pylist()
    except KeyError as error:
        raise ValueError(f"{table} has no column {error}") from None
    if numbers != list(range(len(numbers))) or not all(isinstance(each, float) for each in returns):
        raise ValueError(f"{table}: its episodes are not numbered from 0, each with a return")
    return returns


def paired(new: Sequence[float], old: Sequence[float]) -> dict[str, Any]:
    """The difference ``new`` - ``old``, which have the same order; there are as many pairs as the shorter one has values.

    Returns:
        ``difference``, its interval ``low`` to ``high``, the ``verdict`` (``better``, ``worse`` or ``within noise``; for a single
        pair ``unknown``), ``method`` and ``pairs``. Raises ValueError without a pair, ImportError without scipy.
    """
    apart = [a - b for a, b in zip(new, old, strict=False)]
    if not apart:
        raise ValueError("no episode has a partner")
    mean, count = fmean(apart), len(apart)
    found = {"difference": mean, "low": None, "high": None, "verdict": "unknown", "method": "paired", "pairs": count}
    if count < 2:
        return found
    half = quantile(count - 1) * stdev(apart) / math.sqrt(count)
    return {**found, "low": mean - half, "high": mean + half, "verdict": verdict(mean - half, mean + half)}


def verdict(low: float, high: float) -> str:
    """The verdict for the interval of a difference."""
    return "better" if low > 0 else "worse" if high < 0 else "within noise"


def quantile(freedom: float) -> float:
    """Student's t for a 95 % interval."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + LEVEL / 2))
