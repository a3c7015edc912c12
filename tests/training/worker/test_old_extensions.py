"""Tasks and an algorithm that were written against an older commit's public names train today."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import REPOSITORY, Serving

FORMER = REPOSITORY / "tests" / "data" / "former"
TRAININGS = {
    "task-of-terms": {
        "task": "my_task:Pendulum",
        "algorithm": "my_algorithm:Mine",
        "config": {"rewards": {"effort": -0.02}, "randomize": {"mass": [0.9, 1.1]}},
    },
    "task-of-kernels": {"task": "my_kernels:PendulumByHand", "ppo": {"hidden_sizes": [8], "minibatches": 1}},
}


@pytest.mark.parametrize("name", TRAININGS)
def test_it_trains(server: Serving, tmp_path: Path, name: str) -> None:
    for module in ("my_task.py", "my_kernels.py", "my_algorithm.py"):
        shutil.copy(FORMER / module, tmp_path)
    train = {**TRAININGS[name], "worlds": 8, "iterations": 3}
    (tmp_path / "job.yaml").write_text(yaml.safe_dump({"name": name, "nodes": 1, "train": train}))
    done = server.muster("submit", "job.yaml", "-f", cwd=tmp_path)
    assert done.returncode == 0 and "SUCCEEDED" in done.stdout, done.stdout + done.stderr
    (run,) = Store(server.home / "store").runs()
    assert [record["iteration"] for record in read_metrics(run)] == [1, 2, 3]
