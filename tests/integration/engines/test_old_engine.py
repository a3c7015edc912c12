"""An engine that was written against an older commit's public names, and against its protocol: ``observe`` takes one handle."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import MAIN_LAST, REPOSITORY, Serving

FORMER = REPOSITORY / "tests" / "data" / "former"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path of whatever is started, with the engine, its test, and what pip would write of its entry point."""
    folder = tmp_path / "plain"
    about = folder / "muster_plain-1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: muster-plain\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[muster.engines]\nplain = muster_plain:ENGINE\n")
    shutil.copy(FORMER / "muster_plain.py", folder)
    shutil.copy(FORMER / "plain_suite.py", folder / "test_plain.py")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return folder


def test_it_passes_the_suite_of_engines(installed: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_plain.py"]
    done = subprocess.run(command, cwd=installed, env=os.environ, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and " passed" in done.stdout, done.stdout + done.stderr


def test_a_controller_runs_a_gang_on_it(installed: Path, tmp_path: Path) -> None:
    with Serving(tmp_path / "home", "--engine", "plain", "--cpus", "2") as server:
        job = server.gang("import os; print('node', os.environ['AWS_BATCH_JOB_NODE_INDEX'])" + MAIN_LAST, nodes=2)
        assert server.wait(job)["status"] == "SUCCEEDED"
        assert {"node 0", "node 1"} <= set(server.log(job))
        assert server.detail(job)["attempts"][0]["computeEnvironment"] == "plain"
