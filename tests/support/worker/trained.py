"""One run that was really trained, for the tests that train a policy only to have one: made once, whatever number of processes tests."""

from __future__ import annotations

import fcntl
import os
import shutil
from pathlib import Path

import pytest

from shared_store.volume.layout import Run, Store
from tests.conftest import run_muster

CHANGES = ("name=cart", "nodes=1", "train.worlds=8", "train.iterations=2", "checkpoint.every=1")
"""To ``job_specs/cartpole.yaml``; and the learning rate, which a test of a resume asks for again."""


def make_once(factory: pytest.TempPathFactory) -> Path:
    """The home of a controller that trained a cart-pole for two iterations, with a checkpoint of each; not to be written to."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    home, whole = shared / "trained", shared / "trained.whole"
    with open(shared / "trained.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not whole.exists():
            shutil.rmtree(home, ignore_errors=True)  # of a process that was ended while it made this
            options = [f"--set={change}" for change in (*CHANGES, "train.ppo.learning_rate=0.001")]
            done = run_muster("run", "job_specs/cartpole.yaml", *options, home=home, timeout=300)
            assert done.returncode == 0, done.stdout + done.stderr
            whole.touch()
    return home


def run_in(home: Path) -> Run:
    """The run in a copy of it."""
    (run,) = [each for each in Store(home / "store").runs() if each.name.startswith("cart-")]
    return run
