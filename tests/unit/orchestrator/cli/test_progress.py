"""The progress of a training, as plain lines and as a bar."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.cli.progress import _Bar, _Lines, following
from orchestrator.domain.errors import ApiError

DETAIL: dict[str, Any] = {
    "spec": {"train": {"iterations": 9}},
    "nodes": 1,
    "name": "cart",
    "id": "0" * 36,
    "run": "cart-1",
}
RECORD = {"iteration": 3, "reward": 1.0, "time": 1.0, "warnings": ["it unlearns: (RUN@best)"]}


def running(phase: str | None, attempts: int = 1) -> dict[str, Any]:
    existing = [{"epoch": 1, "nodes": [{}]}] * attempts
    return {"status": "RUNNING", "statusReason": "attempt 1 runs on 1 node", "phase": phase, "attempts": existing}


def test_a_warning_names_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    lines = _Lines(DETAIL)
    lines.show(running("training"), RECORD)
    lines.show(running("training"), None)
    assert "\nwarning: it unlearns: (cart-1@best)\n" in capsys.readouterr().out
    bar = _Bar(DETAIL)
    bar.show(running("training"), RECORD)
    assert bar._progress.tasks[0].fields["text"].endswith("  warning: it unlearns: (cart-1@best)")


LAST = {**RECORD, "iteration": 9, "warnings": []}
PHASES = {
    None: "loading libraries",
    "compiling kernels": "compiling kernels",
    "building worlds": "building worlds",
    "training": "training",
}
AT_THE_END = ("saving the last checkpoint", "evaluating", "writing the results", "drawing the policy")


def test_plain_lines_have_each_phase_once_before_the_first_iteration_and_after_the_last(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with _Lines(DETAIL) as lines:
        for phase in PHASES:
            lines.show(running(phase), None)
            lines.show(running(phase), None)
        lines.show(running("training"), RECORD)
        lines.show(running("building worlds"), RECORD)  # what the node reported before its first iteration
        lines.show(running(AT_THE_END[0]), LAST)
        for phase in AT_THE_END:
            lines.show(running(phase), None)
    printed = [each for each in capsys.readouterr().out.splitlines() if not each.startswith(("iteration", "warning"))]
    assert printed[2:] == [*PHASES.values(), *AT_THE_END]


def test_plain_lines_count_compiled_kernels_at_intervals(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    lines = _Lines(DETAIL)
    for count in ("0/120", "1/120", "37/120", "37/120", "120/120"):
        lines.show({**running("compiling kernels"), "phase_count": count}, None)
        now[0] += 1.5
    lines.show({**running("training"), "phase_count": None}, None)
    printed = capsys.readouterr().out.splitlines()[1:]
    assert printed == [*(f"compiling kernels {count}" for count in ("0/120", "37/120", "120/120")), "training"]


def test_the_bar_shows_the_phase_and_for_how_long_unless_iterations_come(monkeypatch: pytest.MonkeyPatch) -> None:
    bar, now = _Bar(DETAIL), [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])

    def text(job: dict[str, Any], record: dict[str, Any] | None = None) -> str:
        bar.show(job, record)
        return str(bar._progress.tasks[0].fields["text"])

    assert text(running(None)) == "loading libraries (0 s)"
    now[0] = 70.0
    assert text(running("compiling kernels")) == f"{PHASES['compiling kernels']} (0 s)"
    now[0] = 95.0
    assert text(running("compiling kernels")) == f"{PHASES['compiling kernels']} (25 s)"
    assert text(running("training")) == "training (0 s)", "the first iteration"
    assert text(running("training"), RECORD).startswith("3/9  reward 1.00")
    assert text(running("training")).startswith("3/9  reward 1.00")
    assert text(running("evaluating"), LAST).startswith("9/9  reward 1.00")
    assert text(running("evaluating")) == "evaluating (0 s)"
    assert text(running(None)) == "evaluating (0 s)", "an engine without the bus"
    assert text(running(None, attempts=2)) == "loading libraries (0 s)"
    assert (
        text({**running(None), "status": "RUNNABLE", "statusReason": "waits for job a"}) == "RUNNABLE: waits for job a"
    )


def test_a_follower_that_the_controller_refuses_from_now_on_learns_that_the_job_continues() -> None:
    with (
        pytest.raises(
            ApiError, match=r"^job 00000000 is not stopped, but .*: a token is needed; then: muster logs 00000000 -f$"
        ),
        following(DETAIL["id"]),
    ):
        raise ApiError("a token is needed", 403)
