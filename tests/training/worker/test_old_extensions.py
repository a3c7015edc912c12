"""Tasks and an algorithm that were written against an older commit's public names train today."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import yaml

from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import REPOSITORY, Serving
from worker.tasks import find_task
from worker.tasks.run.mistakes import TaskMistake

FORMER = REPOSITORY / "tests" / "data" / "former"
TRAININGS = {
    "task-of-terms": {
        "task": "my_task:Pendulum",
        "algorithm": "my_algorithm:Mine",
        "config": {"rewards": {"effort": -0.02}, "randomize": {"mass": [0.9, 1.1]}},
    },
}


@pytest.mark.parametrize("name", TRAININGS)
def test_it_trains(server: Serving, tmp_path: Path, name: str) -> None:
    for module in ("my_task.py", "my_algorithm.py"):
        shutil.copy(FORMER / module, tmp_path)
    train = {**TRAININGS[name], "worlds": 8, "iterations": 3}
    (tmp_path / "job.yaml").write_text(yaml.safe_dump({"name": name, "nodes": 1, "train": train}))
    done = server.muster("submit", "job.yaml", "-f", cwd=tmp_path)
    assert done.returncode == 0 and "SUCCEEDED" in done.stdout, done.stdout + done.stderr
    (run,) = Store(server.home / "store").runs()
    assert [record["iteration"] for record in read_metrics(run)] == [1, 2, 3]


def test_a_task_of_two_kernels_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(FORMER / "my_kernels.py", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TaskMistake) as caught:
        find_task("my_kernels:PendulumByHand")
    assert re.fullmatch(
        r"task my_kernels:PendulumByHand: \S+my_kernels\.py:64: task PendulumByHand: it is two kernels, act and observe, .+own-task\.md\)",
        str(caught.value),
    )
