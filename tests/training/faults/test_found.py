"""What the torture has found, each as a small test."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path

from shared_store.volume.checkpoints import list_checkpoints
from tests.conftest import Serving
from tests.support.worker.trained import run_in


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
