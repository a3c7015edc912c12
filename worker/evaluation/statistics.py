"""Statistics with their 95 % confidence intervals: means, shares and differences.

Sources: Student (1908) for a mean; Wilson (1927), "Probable inference, the law of succession, and statistical inference", for a share;
Welch (1947), "The generalization of Student's problem when several different population variances are involved", for a difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import torch

from shared_store.volume.paired_episodes import LEVEL, quantile, verdict


@dataclass(frozen=True)
class Sample:
    """The statistics of a sample for a comparison: its size, mean and standard deviation (of n - 1)."""

    count: int
    mean: float
    std: float

    @classmethod
    def of(cls, values: torch.Tensor) -> Sample:
        """Of the ``values``, shape ``(n,)``."""
        std = float(values.std()) if len(values) > 1 else 0.0
        return cls(len(values), float(values.mean()), std)

    def describe(self) -> dict[str, float | None]:
        """``mean``, ``std``, and ``low`` and ``high``: mean ∓ t(n - 1) · std / √n; no interval of one value."""
        if self.count < 2:
            return {"mean": self.mean, "std": None, "low": None, "high": None}
        half = quantile(self.count - 1) * self.std / math.sqrt(self.count)
        return {"mean": self.mean, "std": self.std, "low": self.mean - half, "high": self.mean + half}


def share(hits: int, count: int) -> dict[str, float]:
    """``count`` of the hits, their ``share``, and Wilson's interval ``low`` to ``high``, which stays in 0 to 1 even for none and all.

    (p + z²/2n ∓ z √(p (1 - p)/n + z²/4n²)) / (1 + z²/n) with z = 1.96.
    """
    z = NormalDist().inv_cdf(0.5 + LEVEL / 2)
    portion = hits / count
    middle = portion + z**2 / (2 * count)
    half = z * math.sqrt(portion * (1 - portion) / count + z**2 / (4 * count**2))
    scale = 1 + z**2 / count
    return {
        "count": hits,
        "share": portion,
        "low": (middle - half) / scale if hits else 0.0,
        "high": (middle + half) / scale if hits < count else 1.0,
    }


def difference(new: Sample, old: Sample) -> dict[str, Any]:
    """The rise from ``old`` to ``new``: ``difference``, its Welch interval ``low`` to ``high``, and the ``verdict``.

    The verdict is ``better`` or ``worse`` where the interval leaves 0 out, else ``within noise``; ``unknown`` of samples of one value.
    """
    apart = new.mean - old.mean
    if new.count < 2 or old.count < 2:
        return {"difference": apart, "low": None, "high": None, "verdict": "unknown"}
    parts = [sample.std**2 / sample.count for sample in (new, old)]
    variance = sum(parts)
    half = 0.0
    if variance > 0:
        freedom = variance**2 / sum(
            part**2 / (sample.count - 1) for part, sample in zip(parts, (new, old), strict=True)
        )
        half = quantile(freedom) * math.sqrt(variance)
    low, high = apart - half, apart + half
    return {"difference": apart, "low": low, "high": high, "verdict": verdict(low, high)}
