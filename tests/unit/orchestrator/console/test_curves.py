"""Curves of the console: a window of a run's metrics, thinned."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from orchestrator.console.curves import columns, curves_of, number
from shared_store.layout import Run
from shared_store.metrics import MetricsWriter

METRICS = 8


def record(iteration: int) -> dict[str, Any]:
    terms = {f"reward_{i}": iteration * i / 10 for i in range(METRICS - 2)}
    return {"iteration": iteration, "reward": float(iteration), "note": "text", "kl": None, "done": True, **terms}


@pytest.fixture(scope="module")
def long_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """10,000 iterations of some metrics."""
    run = Run(tmp_path_factory.mktemp("long"))
    with MetricsWriter(run, 1, 0) as writer:
        for iteration in range(1, 10_001):
            writer.write(record(iteration))
    return run


def test_a_long_history_is_thinned_to_points_from_its_first_iteration_to_its_last(long_run: Run) -> None:
    found = curves_of(long_run, ["reward"], points=300)
    iterations = found["iterations"]
    assert len(iterations) <= 300 and iterations[0] <= 50 and iterations[-1] == found["last"] == 10_000
    assert max(b - a for a, b in pairwise(iterations)) <= 100
    assert found["series"]["reward"] == iterations


@pytest.mark.parametrize(("begin", "end", "step"), [(500, 599, 1), (1, 100, 1), (3000, 6000, 31), (200, 9000, 60)])
def test_a_window_has_its_own_points(long_run: Run, begin: int, end: int, step: int) -> None:
    iterations = curves_of(long_run, ["reward"], begin, end, 300)["iterations"]
    assert begin <= iterations[0] <= begin + step and end - step <= iterations[-1] <= end
    assert max(b - a for a, b in pairwise(iterations)) <= step


def test_a_window_beyond_the_end_is_empty_and_a_run_without_metrics_has_no_curves(
    long_run: Run, tmp_path: Path
) -> None:
    assert curves_of(long_run, [], 10_001)["iterations"] == []
    assert curves_of(Run(tmp_path)) == {"first": 0, "last": 0, "iterations": [], "series": {}}


def test_what_an_attempt_has_superseded_is_in_no_curve(tmp_path: Path) -> None:
    run = Run(tmp_path)
    with MetricsWriter(run, 1, 0) as writer:
        for iteration in range(1, 11):
            writer.write({"iteration": iteration, "reward": 1})
    with MetricsWriter(run, 2, 4) as writer:
        writer.write({"iteration": 5, "reward": 2})
    assert curves_of(run)["series"]["reward"] == [1, 1, 1, 1, 2]


def test_names_choose_metrics_and_groups_only_numbers_are_drawn_and_each_rank_has_its_curve() -> None:
    records = [record(1), {"iteration": 2, "reward": None, "reward_1": 3.0}]
    assert columns(records, ["reward", "kl", "nothing"])["series"] == {"reward": [1.0, None]}
    assert len(columns(records, ["reward_*"])["series"]) == METRICS - 2
    assert set(columns(records, ["done", "note", "reward_1"])["series"]) == {"reward_1"}
    shown = {"1": None, 1 / 3: 0.333333, 12345678901: 12345678901}
    assert {value: number(value) for value in shown} == shown and number(float("nan")) is None
    records = [{"iteration": 1, "rank_collect_seconds": [0.1, 0.3]}, {"iteration": 2, "rank_collect_seconds": [0.2]}]
    expected = {"rank_collect_seconds/0": [0.1, 0.2], "rank_collect_seconds/1": [0.3, None]}
    assert columns(records, ["rank_*"])["series"] == columns(records, ["*"])["series"] == expected
