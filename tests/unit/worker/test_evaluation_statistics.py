"""Intervals and comparisons of an evaluation, against values from textbooks and by hand."""

from __future__ import annotations

import math

import pytest
import torch

from shared_store.pairs import are_paired, paired
from worker.evaluation.statistics import Sample, difference, share


def test_the_interval_of_a_mean_is_student_s() -> None:
    found = Sample.of(torch.tensor([2.0, 4.0, 4.0, 6.0], dtype=torch.float64)).describe()
    # t of 3 degrees of freedom; squares of deviations 8, n - 1 = 3, root of n = 2
    half = 3.182446305 * math.sqrt(8 / 3) / 2
    assert found["mean"] == 4.0 and found["std"] == pytest.approx(math.sqrt(8 / 3))
    assert (found["low"], found["high"]) == (pytest.approx(4.0 - half), pytest.approx(4.0 + half))
    assert Sample.of(torch.tensor([3.0])).describe() == {"mean": 3.0, "std": None, "low": None, "high": None}


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    # Newcombe (1998), Two-sided confidence intervals for the single proportion, table I, method 3
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_the_interval_of_a_share_is_wilson_s(hits: int, count: int, low: float, high: float) -> None:
    found = share(hits, count)
    assert (found["low"], found["high"]) == (pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))
    assert share(count, count)["high"] == 1.0 and share(count, count)["low"] < 1.0


def test_a_difference_is_welch_s() -> None:
    new, old = Sample(10, 20.0, 4.0), Sample(40, 15.0, 2.0)
    parts = 16 / 10, 4 / 40
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 9 + parts[1] ** 2 / 39)
    assert freedom == pytest.approx(10.15, abs=0.01)
    half = 2.2239 * math.sqrt(sum(parts))  # t of so many degrees of freedom
    found = difference(new, old)
    assert found["difference"] == 5.0 and found["verdict"] == "better"
    assert (found["low"], found["high"]) == (pytest.approx(5 - half, abs=1e-3), pytest.approx(5 + half, abs=1e-3))
    assert difference(old, new)["verdict"] == "worse"
    assert difference(Sample(10, 16.0, 4.0), old)["verdict"] == "within noise"
    # samples without spread are distinguished unless they are equal
    assert difference(Sample(9, 2.0, 0.0), Sample(9, 1.0, 0.0))["verdict"] == "better"
    assert difference(Sample(9, 1.0, 0.0), Sample(9, 1.0, 0.0))["verdict"] == "within noise"
    assert difference(Sample(1, 2.0, 0.0), Sample(9, 1.0, 1.0))["verdict"] == "unknown"


def test_the_interval_of_paired_differences_is_student_s() -> None:
    """Student (1908), table of the Cushny and Peebles data: additional hours of sleep by two drugs, ten patients."""
    first = [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]
    second = [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]
    found = paired(second, [*first, 1e9])
    half = 2.262157163 * 1.229995484 / math.sqrt(10)  # t of 9 degrees of freedom; s of the differences
    assert found["difference"] == pytest.approx(1.58) and found["pairs"] == 10 and found["method"] == "paired"
    assert (found["low"], found["high"]) == (pytest.approx(1.58 - half), pytest.approx(1.58 + half))
    assert found["verdict"] == "better" and paired(first, second)["verdict"] == "worse"
    apart = difference(Sample.of(torch.tensor(second)), Sample.of(torch.tensor(first)))
    assert apart["verdict"] == "within noise", "what pairs tell apart, samples do not"
    assert paired([2.0], [1.0])["verdict"] == "unknown" and paired(first, first)["verdict"] == "within noise"


def test_episodes_are_paired_where_seed_task_and_changes_of_the_worlds_are_the_same() -> None:
    one = {"seed": 7, "task": "Cartpole", "config": {}}
    assert are_paired(one, {**one, "config": None, "episodes": 9})
    for other in ({"seed": 8}, {"task": "Ant"}, {"config": {"angle_limit": 0.3}}):
        assert not are_paired(one, {**one, **other})
    of_a_training = {**one, "seed": None}
    assert not are_paired(of_a_training, of_a_training), "the ends of two trainings: each in its own worlds"
