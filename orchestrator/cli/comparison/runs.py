"""Comparison of runs. Runs that differ only in their seed form a group, with means and standard deviations. Pure."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from shared_store.pairs import are_paired

POINTS = 200
"""Number of points in the curve of a group."""


@dataclass(frozen=True)
class RunFacts:
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
        """How it was trained."""
        return self.spec.get("train") or {}

    @property
    def curve(self) -> list[tuple[float, float]]:
        """Environment steps and mean return at the records with finished episodes."""
        told = ((record.get("env_steps"), record.get("reward")) for record in self.records)
        return [(float(steps), float(reward)) for steps, reward in told if steps is not None and reward is not None]

    def last(self, key: str) -> float | None:
        """A number of the newest record."""
        value = self.records[-1].get(key) if self.records else None
        return float(value) if isinstance(value, int | float) else None


@dataclass(frozen=True)
class Group:
    """Runs whose specs differ only in name and seed."""

    runs: Sequence[RunFacts]

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
        return {
            "runs": [run.name for run in self.runs],
            "seeds": [run.train.get("seed") for run in self.runs],
            "task": self.runs[0].train.get("task"),
            **{key: _spread(self.numbers(key)) for key in ("iteration", "env_steps", "reward", "episode_length")},
            "evaluated": _spread([each["mean_return"] for each in self.evaluations]),
            "success": _spread(self._successes()),
            "evaluations": self.evaluations,
        }

    def cells(self) -> list[str]:
        """A row of the table."""
        seeds = ", ".join(str(run.train.get("seed", "-")) for run in self.runs)
        evaluated = [each["mean_return"] for each in self.evaluations]
        shares = [100 * share for share in self._successes()]
        told = self.evaluations[0].get("return") if len(self.evaluations) == 1 else None
        high = told.get("high") if isinstance(told, Mapping) else None
        single = f"{evaluated[0]:.2f} ± {high - evaluated[0]:.2f}" if isinstance(high, int | float) else None
        return [
            self.label,
            seeds,
            str(self.runs[0].train.get("task", "-")),
            _shown(self.numbers("iteration"), ".0f"),
            _shown(self.numbers("env_steps"), ",.0f"),
            _shown(self.numbers("reward"), ".2f"),
            _shown(self.numbers("episode_length"), ".1f"),
            single or _shown(evaluated, ".2f"),
            f"{_shown(shares, '.1f')} %" if shares else "-",
        ]

    def _successes(self) -> list[float]:
        told = [each.get("success") for each in self.evaluations]
        return [float(each["share"]) for each in told if isinstance(each, Mapping)]

    def curve(self) -> list[tuple[float, float, float, int]]:
        """Steps, mean return of its runs, their standard deviation and their number, up to the end of the longest run.

        Returns are interpolated linearly between records; a run counts only within its records.
        """
        curves = [run.curve for run in self.runs if run.curve]
        if not curves:
            return []
        first, last = min(curve[0][0] for curve in curves), max(curve[-1][0] for curve in curves)
        points = [first + (last - first) * index / (POINTS - 1) for index in range(POINTS)]
        if len(curves) == 1:
            points = [steps for steps, _ in curves[0]]
        found = []
        for steps in points:
            there = [value for curve in curves if (value := _at(curve, steps)) is not None]
            if there:
                found.append((steps, fmean(there), stdev(there) if len(there) > 1 else 0.0, len(there)))
        return found


def grouped(runs: Iterable[RunFacts]) -> list[Group]:
    """The runs in groups, in the order of their first ones."""
    groups: dict[str, list[RunFacts]] = {}
    for run in runs:
        spec = {key: value for key, value in run.spec.items() if key not in ("name", "train")}
        train = {key: value for key, value in run.train.items() if key != "seed"}
        # without a spec, runs can't be compared
        key = json.dumps([spec, train], sort_keys=True) if run.train else run.name
        groups.setdefault(key, []).append(run)
    return [Group(each) for each in groups.values()]


def same_episodes(new: RunFacts, old: RunFacts) -> tuple[Mapping[str, Any], Mapping[str, Any]] | None:
    """An evaluation of each of two runs on the same episodes: the pair with the most common episodes; None without any."""
    both = [(a, b) for a in new.evaluations for b in old.evaluations if are_paired(a, b)]
    return max(both, key=lambda pair: min(pair[0]["episodes"], pair[1]["episodes"]), default=None)


def _at(curve: Sequence[tuple[float, float]], steps: float) -> float | None:
    """The value of a curve, linearly interpolated; None outside."""
    if not curve[0][0] <= steps <= curve[-1][0]:
        return None
    index = bisect_right(curve, steps, key=lambda point: point[0])
    if index == len(curve):
        return curve[-1][1]
    (before, low), (after, high) = curve[index - 1], curve[index]
    return low + (high - low) * (steps - before) / (after - before)


def _spread(values: Sequence[float]) -> dict[str, float | None] | None:
    if not values:
        return None
    return {"mean": fmean(values), "std": stdev(values) if len(values) > 1 else None}


def _shown(values: Sequence[float], pattern: str) -> str:
    if not values:
        return "-"
    mean = format(fmean(values), pattern)
    return f"{mean} ± {format(stdev(values), pattern)}" if len(values) > 1 and len(set(values)) > 1 else mean
