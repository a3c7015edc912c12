"""Comparison of runs. Runs that differ only in their seed form a group, with means and standard deviations."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from shared_store.contract.error_text import counted
from shared_store.volume.paired_episodes import are_paired, paired, read_returns

COLUMNS = ("RUNS", "SEEDS", "TASK", "ITERATION", "STEPS", "REWARD", "LENGTH", "EVALUATED", "SUCCESS")
"""Of the table; see :meth:`RunGroup.cells`."""
POINTS = 200
"""Number of points in the curve of a group."""


@dataclass(frozen=True)
class ComparedRun:
    """The data of one run to compare.

    Attributes:
        name: Name of the run.
        spec: Its job YAML; empty without one.
        records: Its metrics, one per iteration.
        evaluation: The summary of an evaluation; None without one.
        evaluations: The summaries of all evaluations of the same checkpoint.
        path: Its directory in the store.
    """

    name: str
    spec: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]
    evaluation: Mapping[str, Any] | None
    evaluations: Sequence[Mapping[str, Any]] = ()
    path: str = ""

    @property
    def train(self) -> Mapping[str, Any]:
        """The ``train`` section of its spec."""
        train = self.spec.get("train")
        return train if isinstance(train, Mapping) else {}

    def curve(self, metric: str = "reward") -> list[tuple[float, float]]:
        """Environment steps and a metric, where it has a value: the mean return where episodes have ended."""
        points = ((record.get("env_steps"), record.get(metric)) for record in self.records)
        return [(float(x), float(y)) for x, y in points if isinstance(x, int | float) and isinstance(y, int | float)]

    def last(self, key: str) -> float | None:
        """A number of the newest record."""
        value = self.records[-1].get(key) if self.records else None
        return float(value) if isinstance(value, int | float) else None


@dataclass(frozen=True)
class RunGroup:
    """Runs whose specs differ only in name and seed."""

    runs: Sequence[ComparedRun]

    @property
    def label(self) -> str:
        """The name of its run, or the common part of several names."""
        first, last = min(run.name for run in self.runs), max(run.name for run in self.runs)
        if len(self.runs) == 1:
            return first
        shared = next((i for i, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1]), len(first))
        return f"{first[:shared]}* ({len(self.runs)})"

    def numbers(self, key: str) -> list[float]:
        """A number of the newest record, for each run that has it."""
        return [value for run in self.runs if (value := run.last(key)) is not None]

    @property
    def evaluations(self) -> list[Mapping[str, Any]]:
        """Evaluations of its runs."""
        return [run.evaluation for run in self.runs if run.evaluation]

    def describe(self) -> dict[str, Any]:
        """As JSON values."""
        successes = [each.get("success") for each in self.evaluations]
        shares = [each.get("share") for each in successes if isinstance(each, Mapping)]
        return {
            "runs": [run.name for run in self.runs],
            "seeds": [run.train.get("seed") for run in self.runs],
            "task": self.runs[0].train.get("task"),
            **{key: _spread(self.numbers(key)) for key in ("iteration", "env_steps", "reward", "episode_length")},
            "evaluated": _spread([each["mean_return"] for each in self.evaluations]),
            "success": _spread([float(share) for share in shares if isinstance(share, int | float)]),
            "evaluations": self.evaluations,
        }

    def cells(self) -> list[str]:
        """A row of the table, by :data:`COLUMNS`."""
        facts = self.describe()
        returns = self.evaluations[0].get("return") if len(self.evaluations) == 1 else None
        high = returns.get("high") if isinstance(returns, Mapping) else None
        mean = facts["evaluated"] and facts["evaluated"]["mean"]
        return [
            self.label,
            ", ".join(str(run.train.get("seed", "-")) for run in self.runs),
            str(self.runs[0].train.get("task", "-")),
            _shown(facts["iteration"], ".0f"),
            _shown(facts["env_steps"], ",.0f"),
            _shown(facts["reward"], ".2f"),
            _shown(facts["episode_length"], ".1f"),
            f"{mean:.2f} ± {high - mean:.2f}" if isinstance(high, int | float) else _shown(facts["evaluated"], ".2f"),
            f"{_shown(facts['success'], '.1f', 100)} %" if facts["success"] else "-",
        ]

    def curve(self, metric: str = "reward", at: Sequence[float] | None = None) -> list[tuple[float, float, float, int]]:
        """Steps, mean of a metric (the return) over its runs, their standard deviation, and how many they are.

        Between two of its records a run's metric is taken to change in proportion; a run counts where it has records.

        Args:
            metric: Its name in the records.
            at: The steps that are wanted; as far as the longest run went where None.
        """
        curves = [curve for run in self.runs if (curve := run.curve(metric))]
        if at is None and curves:
            at = [steps for steps, _ in curves[0]] if len(curves) == 1 else spaced(span(curves), POINTS)
        found = []
        for steps in at or ():
            values = [value for curve in curves if (value := _at(curve, steps)) is not None]
            if values:
                found.append((steps, fmean(values), stdev(values) if len(values) > 1 else 0.0, len(values)))
        return found


def span(curves: Iterable[Sequence[tuple[float, float]]]) -> tuple[float, float]:
    """The least and the greatest steps of curves that have points."""
    ends = [(curve[0][0], curve[-1][0]) for curve in curves]
    return min(first for first, _ in ends), max(last for _, last in ends)


def spaced(ends: tuple[float, float], count: int) -> list[float]:
    """So many values, evenly spaced between two ends, which are the first and the last."""
    first, last = ends
    return [first + (last - first) * index / (count - 1) for index in range(count)]


def facts_of(
    described: Mapping[str, Any],
    records: Sequence[Mapping[str, Any]],
    checkpoints: Sequence[Mapping[str, Any]],
    evaluations: Sequence[Mapping[str, Any]],
) -> ComparedRun:
    """The compared facts of a run, from the native API's answers about it, its metrics, its checkpoints and its evaluations.

    It is judged by its best checkpoint that has an evaluation, else by the last one that has.
    """
    best = next((each for each in checkpoints if each["best"] and each["evaluated"]), None)
    judged = best or next((each for each in reversed(checkpoints) if each["evaluated"]), None)
    of_it = [each for each in evaluations if judged and each["checkpoint"] == judged["name"]]
    called = judged["evaluated"]["name"] if judged else None
    evaluation = next((each for each in evaluations if each["name"] == called), None)
    return ComparedRun(described["run"], described["spec"] or {}, records, evaluation, of_it, described["path"])


def grouped(runs: Iterable[ComparedRun]) -> list[RunGroup]:
    """The runs in groups, in the order of their first ones."""
    groups: dict[str, list[ComparedRun]] = {}
    for run in runs:
        spec = {key: value for key, value in run.spec.items() if key not in ("name", "train")}
        train = {key: value for key, value in run.train.items() if key != "seed"}
        # without a spec, runs can't be compared
        key = json.dumps([spec, train], sort_keys=True) if run.train else run.name
        groups.setdefault(key, []).append(run)
    return [RunGroup(each) for each in groups.values()]


def versus(group: RunGroup, first: RunGroup) -> dict[str, Any] | None:
    """The difference of a single run from the first one in the same episodes; None where they have none, or these can't be read here.

    Returns:
        ``new`` and ``old`` (as ``RUN@ITERATION``), and what :func:`shared_store.volume.paired_episodes.paired` finds.
    """
    if group is first or len(group.runs) > 1 or len(first.runs) > 1:
        return None
    both = group.runs[0], first.runs[0]
    pairs = [pair for pair in product(*(run.evaluations for run in both)) if are_paired(*pair)]
    pair = max(pairs, key=lambda pair: min(each["episodes"] for each in pair), default=None)
    if pair is None:
        return None
    tables = [Path(run.path) / f"evaluations/{each['name']}.parquet" for run, each in zip(both, pair, strict=True)]
    try:
        compared = paired(*map(read_returns, tables))
    except (ImportError, OSError, ValueError):  # the store is on another machine, say
        return None
    names = [f"{run.name}@{each.get('iteration')}" for run, each in zip(both, pair, strict=True)]
    return {"new": names[0], "old": names[1], **compared}


def sentence(result: Mapping[str, Any]) -> str:
    """The result of :func:`versus`, in words."""
    low, high = (f"{end:+.2f}" if end is not None else "-" for end in (result["low"], result["high"]))
    return (
        f"{result['new']} against {result['old']}: return {result['difference']:+.2f} ({low} to {high}, paired over "
        f"{counted(result['pairs'], 'episode')}): {result['verdict']}"
    )


def _at(curve: Sequence[tuple[float, float]], steps: float) -> float | None:
    """The value of a curve, linearly interpolated; None outside."""
    if not curve[0][0] <= steps <= curve[-1][0]:
        return None
    index = min(bisect_right(curve, steps, key=lambda point: point[0]), len(curve) - 1)
    (before, low), (after, high) = curve[index - 1], curve[index]
    return low + (high - low) * (steps - before) / (after - before) if steps < after else high


def _spread(values: Sequence[float]) -> dict[str, float | None] | None:
    return {"mean": fmean(values), "std": stdev(values) if len(values) > 1 else None} if values else None


def _shown(spread: Mapping[str, float | None] | None, pattern: str, scale: float = 1) -> str:
    if not spread or spread["mean"] is None:
        return "-"
    shown = format(scale * spread["mean"], pattern)
    return f"{shown} ± {format(scale * spread['std'], pattern)}" if spread["std"] else shown
