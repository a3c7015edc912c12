"""`muster evaluate` with a real rank: changed worlds, leaving when asked. Two ranks: test_gangs.py."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import worker.evaluate
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.layout import Run
from tests.conftest import PATIENCE, wait_for
from tests.support.processes import has_signal
from tests.support.worker.in_process import call_worker
from tests.support.worker.ranks import ROOT, placement
from tests.support.worker.trained import run_in


def environment(run: Run, section: dict[str, Any], job: str) -> dict[str, str]:
    """What the supervisor passes to the one rank of a job."""
    spec = {"name": "evaluate", "evaluate": {"run": run.name, **section}}
    return {
        **{"MUSTER_STORE": str(run.path.parent.parent), "MUSTER_RUN": "job", "MUSTER_EPOCH": "1"},
        **{"MUSTER_JOB_EPOCH": "1", "MUSTER_JOB_ID": job, "MUSTER_SPEC": json.dumps(spec), **placement()},
    }


@pytest.fixture(scope="module")
def run(trained_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of two checkpoints."""
    return run_in(shutil.copytree(trained_home, tmp_path_factory.mktemp("copy") / "home"))


def evaluate(run: Run, job: str, **section: Any) -> tuple[int, str]:
    """Exit code and output of a job of one rank."""
    done = call_worker(worker.evaluate.main, environment(run, {"episodes": 40, **section}, job))
    return done.returncode, done.stdout + done.stderr


def test_changed_worlds_an_older_checkpoint_and_another_seed_are_recorded(run: Run) -> None:
    changes = {"episode_seconds": 0.5, "angle_limit": 0.3}
    code, output = evaluate(run, "changed", checkpoint=1, seed=9, episodes=33, worlds=1, config=changes)
    assert code == 0, output
    (reported,) = [each for each in list_evaluations(run) if each["job"] == "changed"]
    assert (reported["iteration"], reported["seed"], reported["config"], reported["max_length"]) == (1, 9, changes, 30)
    assert reported["episodes"] == 33 and reported["versions"]["torch"] and "with config.episode_seconds: 0.5" in output


def test_an_evaluation_that_is_asked_to_stop_leaves_with_75_and_records_nothing(run: Run) -> None:
    before = sorted(path.name for path in run.evaluations.iterdir())
    # 100 s of simulated time: it would take long
    section = {"episodes": 1000, "config": {"episode_seconds": 100.0, "angle_limit": 3.0, "cart_limit": 1e3}}
    process = subprocess.Popen(
        [sys.executable, "-m", "worker.evaluate"],
        env={**os.environ, **environment(run, section, "stopped")},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    wait_for(lambda: has_signal(process.pid, "SigCgt", signal.SIGTERM), 60, "that it listens")
    process.terminate()
    output, _ = process.communicate(timeout=120 * PATIENCE)
    assert process.returncode == 75 and "nothing was recorded" in output, output
    assert sorted(path.name for path in run.evaluations.iterdir()) == before


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"episodes": 0}, "episodes: expected an integer of at least 1, got 0"),
        ({"config": {"angle_limt": 1.0}}, "evaluate.config.angle_limt: CartpoleConfig has no such key; did you mean"),
    ],
)
def test_what_came_without_a_check_at_submission_is_refused_in_one_line(run: Run, section: Any, message: str) -> None:
    code, output = evaluate(run, "wrong", **section)
    assert code == 2 and f"error: {message}" in output and "Traceback" not in output
