"""What a training's records say against it."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from shared_store.volume.learning_metrics import in_log, in_words
from shared_store.volume.metrics import read_metrics, warnings_of
from worker.learning.report import Report
from worker.learning.watch import Watch
from worker.settings.ppo import PPOConfig


def watch(iterations: int = 1000, **settings: Any) -> Watch:
    return Watch(iterations, PPOConfig(**settings))


def record(iteration: int, reward: float | None = None, **figures: Any) -> dict[str, Any]:
    return {"iteration": iteration, "reward": reward, "episodes": 0 if reward is None else 10, **figures}


def started(of: Watch, returns: list[float]) -> list[list[str]]:
    return [of.warnings(record(i, reward)) for i, reward in enumerate(returns, 1)]


RISE = [*([1.0] * 20), *([21.0] * 20)]
"""The first mean is 1, the best 21: a gain of 20, of which 70 % are left at 15."""


@pytest.mark.parametrize(("fallen", "reported"), [(14.0, True), (15.5, False)])
def test_a_fall_below_the_share_of_the_gain_is_reported_after_fifty_iterations(fallen: float, reported: bool) -> None:
    found = started(watch(), [*RISE, *([fallen] * 100)])
    first = next((i for i, texts in enumerate(found, 1) if texts), None)
    # the mean of 20 iterations is below 15 from the twentieth of 14.0 on, that is after iteration 58 (19 of 14 and one of 21 are 14.35)
    assert (first is not None) == reported and (not reported or 40 + 50 < first <= 60 + 50)
    if reported:
        assert found[-1] == [
            "it unlearns: its mean return over 20 iterations is 14.00, below 70% of its gain for 50 iterations; the best was 21.00 at iteration 40 (RUN@best)"
        ]


def test_a_fall_that_ends_in_time_or_that_noise_explains_is_not_reported() -> None:
    assert not any(started(watch(), [*RISE, *([14.0] * 45), *([21.0] * 100)]))
    noisy = [3.0 * math.sin(1000.0 * i) for i in range(300)]  # no gain: what is lost of it says nothing
    assert not any(started(watch(), noisy))


def test_an_end_below_the_best_names_the_checkpoint_to_try() -> None:
    found = started(watch(60), [*RISE, *([18.5] * 20)])
    assert not any(found[:-1])
    assert found[-1] == [
        "it ended below its best: its mean return over 20 iterations is 18.50; it was 21.00 at iteration 40; try its best checkpoint: muster evaluate RUN@best"
    ]
    assert not any(started(watch(60), [*RISE, *([20.0] * 20)]))
    shifted = [900.0 + value for value in (*RISE, *([15.0] * 20))]
    assert "ended below" in started(watch(60), shifted)[-1][0], "the gain counts, wherever the returns begin"


@pytest.mark.parametrize(("deviation", "reported"), [(0.003, True), (0.05, False), (0.0, False), (None, False)])
def test_a_dead_deviation_is_reported_at_once_and_choices_have_none(deviation: float | None, reported: bool) -> None:
    found = watch().warnings(record(3, action_std=deviation))
    assert bool(found) == reported and all("0.003" in text and "min_std" in text for text in found)


@pytest.mark.parametrize(
    ("rate", "kl", "schedule", "reported"),
    [
        (1e-5, 0.02, "adaptive", True),
        (1e-5, 0.009, "adaptive", False),
        (1e-4, 0.02, "adaptive", False),
        (1e-5, 0.02, "fixed", False),
    ],
)
def test_steps_that_stay_too_large_on_the_floor_of_the_rate_are_reported(
    rate: float, kl: float, schedule: str, reported: bool
) -> None:
    of = watch(schedule=schedule)
    found = [of.warnings(record(i, learning_rate=rate, kl=kl)) for i in range(1, 30)]
    assert [bool(texts) for texts in found] == [reported and i > 20 for i in range(1, 30)]


def test_a_resumed_training_remembers_its_best_and_warns_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Store(tmp_path).open().run("cart")
    run.create({})
    raise_epoch(run, 1)
    usual = {"episode_length": 1.0, "steps_per_second": 1.0, "iteration_seconds": 1.0, "total_seconds": 1.0}
    returns = [*RISE, *([2.0] * 100)]
    for epoch, first, last in ((1, 0, 60), (2, 50, 140)):
        job = SimpleNamespace(run=run, epoch=epoch, section={})
        report = Report(SimpleNamespace(job=job, iterations=200, settings=PPOConfig()), first, "cuda:0")
        for iteration in range(first + 1, last + 1):
            report.iteration({**record(iteration, returns[iteration - 1], action_std=0.4), **usual})
        report.close()
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert len(printed) == 1 and "the best was 21.00 at iteration 40 (cart@best)" in printed[0]
    (kept,) = warnings_of(read_metrics(run)[-1], run.name)
    assert kept.startswith("it unlearns: its mean return over 20 iterations is 2.00, ") and kept.endswith("(cart@best)")
    assert "cart" not in str(read_metrics(run)), "records are the same whatever the run is called"


def test_what_a_job_wrote_into_its_record_is_shown_only_where_it_is_text_or_a_number() -> None:
    assert warnings_of({"warnings": ["a", 1, None]}, "cart") == ["a"] and warnings_of({"warnings": "a"}, "cart") == []
    record = {"action_std": 0.41234, "kl": "x", "saturation": None, "clip_fraction": 0.1, "reward": 1.0}
    assert in_words(record) == "deviation of actions 0.41, clip fraction 0.10"
    assert in_log(record) == "kl -  std 0.41  saturated -  clipped 0.10"
