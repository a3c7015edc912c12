"""The watch over a training, by its records: whether it unlearns, no longer explores, or has a learning rate that can't follow."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Mapping
from typing import Any

from shared_store.volume.metrics import THIS_RUN

WINDOW = 20
"""Iterations over which returns are averaged."""
FALLEN = 0.7
"""Share of the gain, from the first mean to the best, below which a training counts as fallen."""
ENDS_BELOW = 0.9
"""The same share for its end."""
PATIENCE = 50
"""Iterations for which it must stay fallen."""
STUCK = 20
"""Iterations for which the learning rate must stay on its floor."""
DEAD = 0.01
"""Standard deviation of the actions below which nothing is explored."""
HISTORY = 2000
"""Number of records of earlier attempts that are read, spread evenly."""


class Watch:
    """Watches the records of a run, in order.

    Args:
        iterations: Iteration at which the training ends.
        settings: The algorithm's settings; the target and the limits of an adaptive rate are read from them, where they have these.
    """

    def __init__(self, iterations: int, settings: Any) -> None:
        self._iterations, self._settings = iterations, settings
        self._window: deque[tuple[float, float]] = deque(maxlen=WINDOW)
        self._first: float | None = None
        self._best, self._best_at = -math.inf, 0
        self._checks = (self._fallen, PATIENCE), (self._dead, 0), (self._stuck, STUCK)
        """Conditions, and the iterations for which each must hold."""
        self._since = [0] * len(self._checks)
        """The first iteration of those in which each has held without a break; 0: it does not hold."""

    def warnings(self, record: Mapping[str, Any]) -> list[str]:
        """The problems after the iteration of ``record``, a line each; usually none."""
        reward, episodes = record.get("reward"), record.get("episodes") or 0
        if episodes and _is_finite(reward):
            self._window.append((float(episodes), float(reward or 0.0)))
        mean = self._mean()
        if mean is not None:
            self._first = mean if self._first is None else self._first
            if mean > self._best:
                self._best, self._best_at = mean, record["iteration"]
        iteration, found = record["iteration"], []
        for number, (check, patience) in enumerate(self._checks):
            text = check(record)
            self._since[number] = (self._since[number] or iteration) if text else 0
            found.append(text if iteration - self._since[number] >= patience else "")
        if iteration == self._iterations:
            found[0] = self._ended()
        return [text for text in found if text]

    def _mean(self) -> float | None:
        """Mean return of the window, weighted by episodes; None until it is full."""
        if len(self._window) < WINDOW:
            return None
        return sum(count * reward for count, reward in self._window) / sum(count for count, _ in self._window)

    def _lost(self, share: float) -> float | None:
        """The present mean, if it is below ``share`` of the gain, and below the best by more than noise."""
        mean = self._mean()
        if mean is None or self._first is None:
            return None
        least = self._first + share * (self._best - self._first)
        noise = statistics.stdev(reward for _, reward in self._window) / math.sqrt(WINDOW)
        return mean if mean < least and self._best - mean > 3.0 * noise else None

    def _fallen(self, record: Mapping[str, Any]) -> str:
        mean = self._lost(FALLEN)
        if mean is None:
            return ""
        return (
            f"it unlearns: its mean return over {WINDOW} iterations is {mean:.2f}, below {FALLEN:.0%} of its gain for {PATIENCE} iterations; the best was "
            f"{self._best:.2f} at iteration {self._best_at} ({THIS_RUN}best)"
        )

    def _ended(self) -> str:
        mean = self._lost(ENDS_BELOW)
        if mean is None:
            return ""
        return (
            f"it ended below its best: its mean return over {WINDOW} iterations is {mean:.2f}; it was {self._best:.2f} at iteration {self._best_at}; "
            f"try its best checkpoint: muster evaluate {THIS_RUN}best"
        )

    def _dead(self, record: Mapping[str, Any]) -> str:
        deviation = record.get("action_std")
        if not _is_finite(deviation) or not 0.0 < float(deviation or 0.0) < DEAD:  # 0: the actions are choices
            return ""
        return f"it no longer explores: the standard deviation of the actions is {deviation:.1g}; raise init_std, min_std or the weight of the entropy"

    def _stuck(self, record: Mapping[str, Any]) -> str:
        settings, kl, rate = self._settings, record.get("kl"), record.get("learning_rate")
        if getattr(settings, "schedule", "") != "adaptive" or not (_is_finite(kl) and _is_finite(rate)):
            return ""
        least, target = settings.learning_rate_limits[0], settings.desired_kl
        if float(rate or 0.0) > 1.001 * least or float(kl or 0.0) <= target:
            return ""
        return (
            f"its steps are too large: KL {kl:.3f} is over desired_kl {target:g} with the learning rate on its floor of {least:g}; "
            "lower learning_rate_limits, or raise min_std"
        )


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
