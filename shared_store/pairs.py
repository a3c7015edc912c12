"""The difference between two policies that played the same episodes: the same worlds, from the same starts.

Student (1908), "The probable error of a mean", whose second example is this test: of the differences d of the pairs the mean,
mean(d) ∓ t(n - 1) · s(d) / √n. What makes one episode harder than another is in both of a pair, and falls out of their difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

LEVEL = 0.95


def are_paired(new: Mapping[str, Any], old: Mapping[str, Any]) -> bool:
    """Whether two evaluations, as their summaries say, played the same episodes as far as both went.

    Episodes have the same number where they have the same world: fewer of them are the first ones of more. At the end of a training
    there is no seed, and the worlds are its own.
    """
    same = all((new.get(key) or None) == (old.get(key) or None) for key in ("seed", "task", "config"))
    return same and isinstance(new.get("seed"), int)


def read_returns(table: Path) -> list[float]:
    """The returns of an evaluation's Parquet table, by the number of their episodes.

    Raises OSError, ValueError for what is no such table, ImportError without pyarrow.
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
    """How far ``new`` is above ``old``, which have the same order: as many pairs as the shorter one has.

    Returns:
        ``difference``, its interval ``low`` to ``high``, the ``verdict`` (``better``, ``worse`` or ``within noise``; of a single
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
    """What an interval of a difference says."""
    return "better" if low > 0 else "worse" if high < 0 else "within noise"


def quantile(freedom: float) -> float:
    """Student's t that a 95 % interval needs."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + LEVEL / 2))
