"""`muster evaluate` with real ranks: the same episodes whatever the worlds and ranks, changed worlds, leaving when asked."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

import worker.evaluate
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.layout import Run
from tests.conftest import PATIENCE, wait_for
from tests.support.processes import has_signal
from tests.support.worker.in_process import call_worker
from tests.support.worker.ranks import ROOT, free_port, placement
from tests.support.worker.trained import run_in
from worker.learning.randomness import held_out_seed

SHORT = {"config": {"episode_seconds": 1.0}}


def environment(
    run: Run, section: dict[str, Any], job: str, rank: int = 0, ranks: int = 1, port: int = 0
) -> dict[str, str]:
    """What the supervisor tells one rank of a job."""
    spec = {"name": "evaluate", "evaluate": {"run": run.name, **section}}
    return {
        **{"MUSTER_STORE": str(run.path.parent.parent), "MUSTER_RUN": "job", "MUSTER_EPOCH": "1"},
        **{"MUSTER_JOB_EPOCH": "1", "MUSTER_JOB_ID": job, "MUSTER_SPEC": json.dumps(spec)},
        **placement(rank, ranks, port),
        "OMP_NUM_THREADS": str(1 + rank),
    }


def start(run: Run, section: dict[str, Any], job: str, rank: int = 0, ranks: int = 1, port: int = 0) -> Any:
    """One rank as a process, as the supervisor starts it."""
    supplied = environment(run, section, job, rank, ranks, port)
    command = [sys.executable, "-m", "worker.evaluate"]
    return subprocess.Popen(
        command, env={**os.environ, **supplied}, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process: Any) -> tuple[int, str]:
    """Exit code and output."""
    output, errors = process.communicate(timeout=120 * PATIENCE)
    return process.returncode, output + errors


@pytest.fixture(scope="module")
def run(trained_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of two checkpoints."""
    return run_in(shutil.copytree(trained_home, tmp_path_factory.mktemp("copy") / "home"))


def evaluate(run: Run, job: str, **section: Any) -> tuple[int, str]:
    """Exit code and output of a job of one rank."""
    done = call_worker(worker.evaluate.main, environment(run, {"episodes": 40, **section}, job))
    return done.returncode, done.stdout + done.stderr


def evaluate_on_two(run: Run, job: str, **section: Any) -> tuple[int, str]:
    """Exit code and output of the main rank of a job of two."""
    port = free_port()
    processes = [start(run, {"episodes": 40, **section}, job, rank, 2, port) for rank in (0, 1)]
    main, _ = [ended(process) for process in processes]
    return main


def test_the_same_episodes_are_the_same_bytes_on_one_rank_in_two_rounds_and_on_two_ranks_in_one(run: Run) -> None:
    config = {**SHORT["config"], "randomize": {"mass": [0.5, 2.0]}}  # each world when it is built
    outputs = [each(run, job, worlds=1, config=config) for job, each in (("one", evaluate), ("two", evaluate_on_two))]
    assert [code for code, _ in outputs] == [0, 0], outputs
    one, two = (run.evaluations / f"00000002-e1-{job}.parquet" for job in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    table = pyarrow.parquet.read_table(one).to_pydict()
    assert len(table["episode"]) == 40 and set(table["seed"]) == {held_out_seed(1)}
    assert "40 episodes of Cartpole, checkpoint 00000002-e1" in outputs[0][1]
    assert "compared with the evaluation" in outputs[1][1] and "paired over 40 episodes): within noise" in outputs[1][1]


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
    section = {
        "episodes": 1000,
        "config": {"episode_seconds": 100.0, "angle_limit": 3.0, "cart_limit": 1e3},
    }
    process = start(run, section, "stopped")
    wait_for(lambda: has_signal(process.pid, "SigCgt", signal.SIGTERM), 60, "that it listens")
    process.terminate()
    code, output = ended(process)
    assert code == 75 and "nothing was recorded" in output, output
    assert sorted(path.name for path in run.evaluations.iterdir()) == before


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"episodes": 0}, "episodes: expected an integer of at least 1, got 0"),
        (
            {"config": {"angle_limt": 1.0}},
            "evaluate.config.angle_limt: CartpoleConfig has no such key; did you mean angle_limit?",
        ),
    ],
)
def test_what_came_without_a_check_at_submission_is_refused_in_one_line(run: Run, section: Any, message: str) -> None:
    code, output = evaluate(run, "wrong", **section)
    assert code == 2 and f"error: {message}" in output and "Traceback" not in output
