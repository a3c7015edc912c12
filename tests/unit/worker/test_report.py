"""What a training says of itself where there is no GPU: once, and only where it would take long."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from orchestrator.cli.progress import shown_metrics
from shared_store.epoch import raise_epoch
from shared_store.layout import Run, Store
from shared_store.metrics import read_metrics, scalars
from worker.learning.report import Report
from worker.plot import plot_reward


def run_of(folder: Path) -> Run:
    run = Store(folder).open().run("r")
    run.create({})
    raise_epoch(run, 1)
    return run


def said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: float, device: str, resumed: int = 0
) -> list[str]:
    """The lines without an iteration's figures, of three iterations of 1,000 that take so long each."""
    run = run_of(tmp_path)
    job = SimpleNamespace(run=run, epoch=1, section={"task": "G1Rough"})
    report = Report(SimpleNamespace(job=job, iterations=1000), resumed, device)
    for iteration in range(resumed + 1, resumed + 4):
        figures = {"reward": None, "episode_length": None, "steps_per_second": 98304.0 / seconds}
        report.iteration({"iteration": iteration, "iteration_seconds": seconds, **figures})
    report.close()
    return [line for line in capsys.readouterr().out.splitlines() if not line.startswith("iteration")]


DAYS = (
    "no GPU: G1Rough trains at about 492 steps/s on these processors, so that the other 998 iterations take about 2.3 days; "
    "--set train.worlds=16 --set train.iterations=20 tries it"
)


@pytest.mark.parametrize(
    ("seconds", "device", "resumed", "warning"),
    [
        # 998 iterations of 200 s are 199,600 s, 2.31 days; 98,304 steps in 200 s are 491.5 a second
        (200.0, "cpu", 0, DAYS),
        # of a resumed training the rest counts: 1,000 - 402 = 598 iterations of 60 s are 9.97 hours
        (60.0, "cpu", 400, "so that the other 598 iterations take about 10 hours; "),
        (20.0, "cpu", 0, ""),  # 5.5 hours
        (200.0, "cuda:0", 0, ""),
    ],
)
def test_a_training_of_many_hours_without_a_gpu_is_warned_about_once_with_a_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: float, device: str, resumed: int, warning: str
) -> None:
    lines = said(tmp_path, capsys, seconds, device, resumed)
    assert len(lines) == bool(warning) and warning in "".join(lines) and (warning != DAYS or lines == [DAYS])


def test_metrics_shown_by_a_task_are_in_the_line_the_record_and_the_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(tmp_path)
    job = SimpleNamespace(run=run, epoch=1, section={})
    report = Report(SimpleNamespace(job=job, iterations=2), 0, "cuda:0")
    usual = {"episode_length": 33.0, "steps_per_second": 100.0, "iteration_seconds": 1.0}
    for iteration, progress in ((1, None), (2, 42.0)):
        shown = {"progress": "- %" if progress is None else "42.0 %"}
        record = {"iteration": iteration, "env_steps": 10 * iteration, "reward": 1.5, "metric_progress": progress}
        report.iteration({**usual, **record, "shown": shown})
    report.close()
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("iteration 1/2  reward 1.50  length 33.0  progress - %  steps/s 100")
    assert second.startswith("iteration 2/2  reward 1.50  length 33.0  progress 42.0 %  steps/s 100")
    last = read_metrics(run)[-1]
    assert last["shown"] == {"progress": "42.0 %"} and "shown" not in scalars(last)
    assert plot_reward(run).read_bytes().startswith(b"\x89PNG")
    assert shown_metrics(last) == "  progress 42.0 %" and shown_metrics({}) == ""
    assert shown_metrics({"shown": {"a\nb": "\x1b[31m1"}}).count("\n") == 0
