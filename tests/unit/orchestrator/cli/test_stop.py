"""What `muster stop` says of a training: how long an iteration takes, and what no checkpoint has."""

from __future__ import annotations

from typing import Any

from orchestrator.cli.jobs import lost_iterations, next_step, slow_iteration


def training(done: int, saved: int, seconds: float = 1.0, **facts: Any) -> dict[str, Any]:
    progress = {"iteration": done, "iteration_seconds": seconds} if done else None
    reported = {
        "name": "ant",
        "kind": "train",
        "status": "RUNNING",
        "progress": progress,
        "results": {"iteration": saved},
        "children": None,
    }
    return {**reported, **facts}


def test_iterations_that_no_checkpoint_has_are_lost_and_a_long_one_is_reported_before_it_is_left() -> None:
    assert lost_iterations(training(7, 7)) == lost_iterations(training(0, 0)) == ""
    assert lost_iterations(training(8, 7)) == "lost: 1 iteration, those after 7 until 8"
    assert lost_iterations(training(3, 0)) == "lost: 3 iterations, those after 0 until 3"
    assert lost_iterations(training(3, 0, kind="command", progress=None, results=None)) == ""
    assert slow_iteration(training(7, 7, seconds=1.0)) == slow_iteration(training(0, 0)) == ""
    assert slow_iteration(training(7, 7, seconds=40.0, status="RUNNABLE")) == ""
    reported = slow_iteration(training(7, 7, seconds=40.0))
    assert reported.startswith("an iteration takes about 40 s; ") and "muster checkpoint ant, then stop" in reported


def test_a_job_that_is_over_says_what_can_follow() -> None:
    facts: dict[str, Any] = {"run": "ant-1", "spec": {"train": {"iterations": 300}}, "results": {"checkpoint": "c"}}
    assert next_step(training(300, 300, status="SUCCEEDED", **facts)) == (
        "; to train it further: muster resume ant-1 --set train.iterations=600 -f"
    )
    assert next_step(training(7, 7, status="FAILED", **facts)) == "; continue with: muster resume ant-1"
    assert next_step(training(0, 0, status="FAILED", **{**facts, "results": {}})) == ""
    command = {
        "kind": "command",
        "status": "FAILED",
        "run": "c-1",
        "results": None,
        "spec": {"command": ["true"]},
        "children": None,
    }
    assert next_step(command) == "; continue with: muster resume c-1"
    assert next_step({**command, "status": "SUCCEEDED"}) == ""
    assert (
        next_step({**command, "spec": None}) == next_step({**command, "children": [{"index": 0}]}) == ""
    )  # of the Batch API
