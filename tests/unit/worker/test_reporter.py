"""What a training says of itself and writes on the volume: reports, warnings, the look at the epoch."""

from __future__ import annotations

import threading
import time
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from orchestrator.cli.progress import shown_metrics
from shared_store.volume.epoch import StaleEpoch, check_epoch, raise_epoch
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import read_metrics, scalars
from tests.support.waiting import wait_for
from worker.evaluation.final_evaluation import plot_reward
from worker.learning import reporter as reporting
from worker.learning.report import Report
from worker.learning.reporter import Fence, Gate, Reporter


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setattr(reporting, "_EVERY", 0.01)
    run = Store(tmp_path).open().run("r")
    run.create({})
    raise_epoch(run, 1)
    return run


def test_a_record_waits_for_the_read_that_a_stopped_process_missed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped, goes_on = threading.Event(), threading.Event()

    def look(*arguments: Any) -> None:
        if stopped.is_set():
            goes_on.wait()
        check_epoch(*arguments)

    monkeypatch.setattr(reporting, "check_epoch", look)
    monkeypatch.setattr(reporting, "_EVERY", 0.05)
    monkeypatch.setattr(reporting, "_LATE", 0.2)
    monkeypatch.setattr(reporting, "_PATIENT", 600.0)
    done: list[int] = []
    overtaken = Fence(run, 1)
    stopped.set()
    wait_for(lambda: time.monotonic() - overtaken._read_at > 0.2)
    raise_epoch(run, 2)
    threading.Timer(0.1, goes_on.set).start()
    overtaken.guard(done.append, 1)
    assert done == []
    with pytest.raises(StaleEpoch):
        overtaken.check()

    goes_on.clear()
    owner = Fence(run, 2)
    wait_for(lambda: time.monotonic() - owner._read_at > 0.2)
    threading.Timer(0.1, goes_on.set).start()
    owner.guard(done.append, 2)
    owner.guard(done.append, 3)
    assert done == [2, 3]
    owner.close()


def test_calls_wait_at_a_gate_that_is_shut_but_only_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reporting, "_HELD", 60.0)
    gate, done = Gate(), []
    reporter = Reporter(gate)
    gate.shut()
    reporter.do(done.append, 1)
    time.sleep(0.1)
    assert done == []
    gate.open()
    wait_for(lambda: done == [1])
    monkeypatch.setattr(reporting, "_HELD", 0.01)
    gate.shut()
    reporter.do(done.append, 2)
    reporter.close()
    assert done == [1, 2]


def test_a_failed_report_is_logged_once_and_later_ones_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    reporter, done = Reporter(), []
    for _ in range(3):
        reporter.do({}.__getitem__, "reward")
    reporter.do(done.append, 1)
    reporter.close()
    reported = capsys.readouterr().out
    assert done == [1]
    assert reported.count("warning: a report failed (KeyError: 'reward'); training goes on without it\n") == 1
    assert "warning: 3 reports failed and were lost" in reported


def test_records_that_a_hanging_volume_refuses_are_dropped_and_counted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "_MOST", 2)
    monkeypatch.setattr(reporting, "_FAREWELL", 0.05)
    reporter, gate, entered = Reporter(), threading.Event(), threading.Event()
    reporter.do(lambda: (entered.set(), gate.wait()))
    entered.wait()
    for _ in range(5):
        reporter.do(print)
    reporter.close()
    gate.set()
    assert "warning: the volume did not take the last metrics (4 were dropped)" in capsys.readouterr().out


@pytest.mark.parametrize("readable", [True, False])
def test_a_fence_reports_a_newer_attempt_and_reads_again_what_cannot_be_read(run: Run, readable: bool) -> None:
    path = run.path / "EPOCH"
    whole = path.read_text()
    if not readable:
        path.write_text("damaged")
    fence = Fence(run, 1)
    time.sleep(0.05)
    fence.check()
    path.write_text(whole)
    raise_epoch(run, 2)
    with pytest.raises(StaleEpoch, match="now belongs to epoch 2"):
        wait_for(fence.check)
    fence.close()


def output(run: Run, capsys: pytest.CaptureFixture[str], seconds: float, device: str, resumed: int) -> list[str]:
    """The lines without an iteration's figures, of three iterations of 1,000 that take so long each."""
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
    run: Run, capsys: pytest.CaptureFixture[str], seconds: float, device: str, resumed: int, warning: str
) -> None:
    lines = output(run, capsys, seconds, device, resumed)
    assert len(lines) == bool(warning) and warning in "".join(lines) and (warning != DAYS or lines == [DAYS])


def test_metrics_and_tensorboard_go_on_after_a_volume_was_away(run: Run, capfd: pytest.CaptureFixture[str]) -> None:
    report = Report(SimpleNamespace(job=SimpleNamespace(run=run, epoch=1, section={}), iterations=99), 0, "cuda:0")
    iterations = count(1)

    def iterate() -> int:
        figures = {"reward": 1.5, "episode_length": None, "steps_per_second": 1.0, "iteration_seconds": 1.0}
        report.iteration({"iteration": (iteration := next(iterations)), **figures})
        return iteration

    def has_failed() -> bool:
        iterate()
        return report._events is None

    def steps() -> set[int]:
        events = EventAccumulator(str(run.metrics)).Reload()
        return {event.step for event in events.Scalars("episode/reward")} if events.Tags()["scalars"] else set()

    began = int(time.time())
    iterate()
    wait_for(lambda: steps() == {1}, 10, "the first event")
    aside = run.path.rename(run.path.with_name("aside"))
    wait_for(has_failed, 10, "the failure")
    assert not run.path.exists()
    aside.rename(run.path)
    wait_for(lambda: int(time.time()) > began, 10, "another second: event files of one second may be read in any order")
    last = iterate()
    report.close()
    output, errors = capfd.readouterr()
    assert output.count("warning: metrics can't be written (") == 1 and "Traceback" not in errors
    assert [record["iteration"] for record in read_metrics(run)] == list(range(1, last + 1))
    assert {1, last} <= steps()


def test_metrics_shown_by_a_task_are_in_the_line_the_record_and_the_plot(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
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
