"""Every job of docs/algorithms.md, as it stands there, ends with the same bits where its rank is killed: through the real command."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.conftest import MUSTER, PATIENCE, REPOSITORY

PAGE = (REPOSITORY / "docs/algorithms.md").read_text()
JOBS = {name: text for text, name in re.findall(r"^```yaml\n(name: (\S+)\n.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)}
(MIRROR,) = re.findall(r"^```python\n(import torch\n\n\ndef mirror.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
SHORT = "sac"
"""The others take half a minute each."""


def muster(home: Path, directory: Path, *arguments: str) -> str:
    environment = {**os.environ, "MUSTER_HOME": str(home)}
    done = subprocess.run(
        [MUSTER, *arguments], cwd=directory, env=environment, capture_output=True, text=True, timeout=300 * PATIENCE
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_page_has_a_job_of_every_kind() -> None:
    assert {
        "critic-of-its-own",
        "gru",
        "symmetry",
        "curious",
        "images",
        "teacher",
        "student",
        "sac",
        "my-algorithm",
    } == set(JOBS)


@pytest.mark.parametrize("name", sorted(JOBS))
def test_killed_it_ends_with_the_same_bits(tmp_path: Path, name: str) -> None:
    if name != SHORT and not os.environ.get("MUSTER_LONG"):
        pytest.skip("half a minute: MUSTER_LONG=1, in make bits")
    (tmp_path / "symmetry.py").write_text(MIRROR)
    (tmp_path / "job_specs").symlink_to(REPOSITORY / "job_specs")
    job = JOBS[name]
    home, options = tmp_path / "home", ["--set", "checkpoint.every=4", "--cpus", "2"]
    if name == "student":
        (tmp_path / "teacher.yaml").write_text(JOBS["teacher"])
        message = muster(home, tmp_path, "run", "teacher.yaml", "--set", "train.iterations=3", *options)
        (run,) = set(re.findall(r"\bteacher-[0-9a-f]{8}\b", message))
        job = re.sub(r"teacher_checkpoint: \S+", f"teacher_checkpoint: {run}@3", job)
    (tmp_path / "job.yaml").write_text(job)
    message = muster(home, tmp_path, "verify-resume", "job.yaml", "--at", "9", "--iterations", "3", *options)
    assert re.search(r"^equal: \d+ tensors, 12 iterations$", message, re.MULTILINE), message
    assert re.search(r"resumed from iteration [48]$", message, re.MULTILINE), message
