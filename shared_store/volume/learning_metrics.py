"""The metrics that show how a training learns: their names in the records, their units, and the words for them everywhere else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from shared_store.volume.metrics import finite


@dataclass(frozen=True)
class LearningMetric:
    """A metric of an algorithm. The algorithms' own documentation says what it measures."""

    name: str
    """In a record."""
    unit: str
    """Empty for a ratio, and for what has the unit of the actions or the rewards."""
    words: str
    """For people: ``explained variance``."""
    short: str = ""
    """In a line of the log; empty: the log leaves it out."""
    form: str = ".3g"
    """Format of its values."""

    @property
    def label(self) -> str:
        """Of a chart: ``KL divergence [nat]``."""
        return f"{self.words[0].upper()}{self.words[1:]}" + (f" [{self.unit}]" if self.unit else "")


LEARNING = (
    LearningMetric("learning_rate", "", "learning rate", "lr", ".1e"),
    LearningMetric("kl", "nat", "KL divergence", "kl", ".3f"),
    LearningMetric("entropy", "nat", "entropy"),
    LearningMetric("temperature", "", "temperature", "temperature", ".1e"),
    LearningMetric("q_mean", "", "mean Q value", "q", ".2f"),
    LearningMetric("v_max_mass", "", "mass at v_max", "at v_max", ".2f"),
    LearningMetric("action_std", "", "deviation of actions", "std", ".2g"),
    LearningMetric("explained_variance", "", "explained variance", "explained", ".2f"),
    LearningMetric("saturation", "", "saturation", "saturated", ".2f"),
    LearningMetric("clip_fraction", "", "clip fraction", "clipped", ".2f"),
    LearningMetric("gradient_norm", "", "gradient norm", "gradient", ".2g"),
)
"""In the order in which they are shown."""


def in_log(record: Mapping[str, Any]) -> str:
    """The metrics of a record for a line of the log: ``kl 0.011  std 0.81``; ``-`` for a value that is not finite."""
    known = [(metric, finite(record[metric.name])) for metric in LEARNING if metric.short and metric.name in record]
    return "  ".join(f"{each.short} {'-' if value is None else format(value, each.form)}" for each, value in known)


def in_words(record: Mapping[str, Any]) -> str:
    """The metrics of a record that are finite, in one line: ``KL divergence 0.011, deviation of actions 0.81``."""
    known = [(metric, finite(record.get(metric.name))) for metric in LEARNING]
    return ", ".join(f"{each.words} {value:{each.form}}" for each, value in known if value is not None)
