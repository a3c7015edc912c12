"""What the torture has found, each as a small test."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path

from shared_store.volume.checkpoints import CheckpointWriter, list_checkpoints
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.worker.trained import run_in


def test_a_commit_removes_what_a_killed_writer_left_but_not_what_comes_next(tmp_path: Path) -> None:
    """A writer that dies does not end its attempt, so nobody may start after it who would sweep."""
    run = Store(tmp_path).open().run("ant")
    run.create({"run": "ant"})
    raise_epoch(run, 2)
    for iteration, epoch in ((10, 1), (20, 2), (40, 2), (10, 3)):
        (CheckpointWriter(run, iteration, epoch).path / "rank-1.pt").write_bytes(b"half")
    (run.checkpoints / ".LATEST.0a1b2c3d.tmp").write_bytes(b"half")
    (run.checkpoints / ".00000005-e1.0a1b2c3d.trash").mkdir()
    writer = CheckpointWriter(run, 30, 2)
    (writer.path / "learner.pt").write_bytes(b"whole")
    writer.commit({}, keep=3)
    assert [checkpoint.name for checkpoint in list_checkpoints(run)] == ["00000030-e2"]
    hidden = sorted(entry.name for entry in run.checkpoints.iterdir() if entry.name.startswith("."))
    assert hidden == [".00000010-e3.tmp", ".00000040-e2.tmp"]


def test_a_job_that_was_struck_after_its_last_save_may_be_resumed_for_its_evaluation(
    trained_home: Path, tmp_path: Path
) -> None:
    with Serving(shutil.copytree(trained_home, tmp_path / "home"), "--cpus", "4") as server:
        run = run_in(server.home)
        (evaluation,) = run.evaluations.glob("*.json")
        before = json.loads(evaluation.read_text())
        refused = server.muster("resume", run.name)
        assert refused.returncode == 1 and "complete at iteration 2 of 2" in refused.stderr
        evaluation.unlink()
        with sqlite3.connect(server.home / "muster.db") as database:  # as if the last attempt had been struck just then
            database.execute("UPDATE jobs SET status = 'FAILED'")
        resumed = json.loads(server.muster("resume", run.name, "--json").stdout)
        assert server.wait(resumed["jobId"], timeout=120)["status"] == "SUCCEEDED"
    after, timings = json.loads(evaluation.read_text()), {"time": 0, "seconds": 0}
    assert {**after, **timings} == {**before, **timings}
    assert [checkpoint.iteration for checkpoint in list_checkpoints(run)] == [1, 2]
