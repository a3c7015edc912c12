"""The racer's modules can be imported, and run as programs, by the names that they had in the worker and the shared store."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import shared_store
import worker
from tests.conftest import REPOSITORY

NAMES = {
    **{old: new for old, new in (shared_store.OLD_NAMES | worker.OLD_NAMES).items() if new.startswith("racer.")},
    "worker.racer.naming": "racer.tracks.naming",
    "worker.racer.rewards.parameters": "racer.rewards.parameters",
    "worker.racer.rewards.samples": "racer.rewards.samples",
    "worker.racer.rewards.reward": "racer.rewards.reward",
    "worker.racer.rewards.translation.translate": "racer.rewards.translation.translate",
}


@pytest.mark.parametrize(("old", "new"), NAMES.items())
def test_an_old_name_is_the_module_of_the_new_one(old: str, new: str) -> None:
    module = import_module(old)
    assert module is import_module(new)
    assert module.__spec__ is not None and module.__spec__.name == new


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)


def test_the_check_of_a_reward_function_runs_by_its_old_name(tmp_path: Path) -> None:
    file = tmp_path / "reward_function.py"
    file.write_text("def reward_function(params):\n    return params['speed']\n")
    done = run("worker.racer.rewards", str(file))
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{file}: valid, compiled to the device\n", "")


def test_the_rank_of_a_race_that_was_submitted_before_runs_by_its_old_name() -> None:
    done, now = run("worker.race"), run("racer.race")
    assert done.returncode == now.returncode != 0 and done.stderr == now.stderr, "it is not a job"
    assert "MUSTER_" in now.stderr, now.stderr
