"""`muster tasks`, and a user's own task: found, listed, trained."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from orchestrator.cli.tasks import TASKS
from orchestrator.cli.terminal import Console
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import REPOSITORY, run_muster
from tests.support.worker.tasks import observe, put, statistics
from worker.learning.job import configure
from worker.tasks import find_task
from worker.tasks.run.find import BUILT_IN

OWN = "job_specs.my_task:Pendulum"


def test_all_tasks_are_listed_with_what_they_see_do_and_are_rewarded_for(tmp_path: Path) -> None:
    done = run_muster("tasks", "--json", home=tmp_path / "home")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    listed = {task["name"]: task for task in found}
    assert listed.keys() >= BUILT_IN.keys()
    for name, where in BUILT_IN.items():
        kind, reported = find_task(name), listed[name]
        task = kind.sketch(kind.config_type())
        assert reported["class"] == where and reported["rewards"] == dict(task.config_type().rewards)
        seen = task.observation_names
        if name == "CartpolePixels":
            seen = ("image: 2 x color of 64 x 64 bytes, the present one first",)
        assert tuple(reported["observations"]) == seen and tuple(reported["actions"]) == task.action_names
        assert reported["control_hz"] == task.config_type().control_hz
    assert not (tmp_path / "home").exists(), "a listing needs no controller"
    console = Console(width=200)
    with console.capture() as captured:  # another process would import the simulation again
        console.print(TASKS.table(found))
    assert re.search(r"^Ant +35 +8 +60 Hz +16 s +forward 1 +heading 0.5 +up 0.1 +alive", captured.get(), re.M)


def test_one_task_is_described_by_name_and_a_wrong_name_is_refused_in_one_line(tmp_path: Path) -> None:
    own = run_muster("tasks", OWN, home=tmp_path).stdout
    assert "cosine, sine, velocity" in own and "upright 1" in own and "hinge" in own
    assert re.search(r"^ROBOTS\nrobot: \S+ kg, 1 joint, 1 actuated joint$", own, re.M), own
    assert max(map(len, own.splitlines())) <= 120 and own.count("\nOBSERVATIONS\n") == own.count("\nACTIONS\n") == 1
    wrong = run_muster("tasks", "Quadrupet", home=tmp_path)  # which imports nothing
    assert wrong.returncode == 2 and len(wrong.stderr.splitlines()) == 1
    assert "no task is called 'Quadrupet'; did you mean Quadruped?" in wrong.stderr
    nowhere = run_muster("tasks", "job_specs.my_task:Pendulun", home=tmp_path)
    assert nowhere.returncode == 2 and "has no class 'Pendulun' that is" in nowhere.stderr
    assert nowhere.stderr.endswith("; did you mean Pendulum?\n")


def test_the_command_imports_no_simulation() -> None:
    script = (
        "import sys, orchestrator.cli, orchestrator.cli.tasks;"
        "print([name for name in ('torch', 'warp', 'newton', 'worker.tasks') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=REPOSITORY, check=True)
    assert done.stdout == "[]\n"


def test_the_example_rewards_and_observes_as_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    task_type = find_task(OWN)
    spec = yaml.safe_load((REPOSITORY / "job_specs/my-task.yaml").read_text())
    task = task_type(configure(task_type, spec["train"]), 4, seed=1)
    assert task.max_episode_length == 240 and task.reward_terms == ("upright", "speed", "effort")
    rows = {"joint_q": [[math.pi], [0.0]], "joint_qd": [[2.0], [0.0], [math.nan]], "episode_length": [10, 239]}
    put(task, **rows, solver_warm_start=[[5.0], [5.0], [math.nan], [5.0]])
    task.actions[:, 0] = torch.tensor([0.5, 0.0, 0.0, 0.0])
    observe(task)
    assert task.observations[0].tolist() == pytest.approx([-1.0, 0.0, 0.2], abs=1e-6)
    assert task.rewards[:2].tolist() == pytest.approx([1.0 - 0.01 * 4.0 - 0.02 * 0.25, -1.0], abs=1e-6)
    assert task.dones[:2].tolist() == task.time_outs[:2].tolist() == [False, True]
    assert statistics(task)["episodes"] == 1 and statistics(task)["nan_worlds"] == 1
    warm = task.state_dict()["solver_warm_start"].flatten().tolist()
    assert warm == [5.0, 0.0, 0.0, 5.0], "an episode begins with a cold solver, that of a world which failed, too"
    assert len(set(task.worlds.solver.mjw_model.body_mass.numpy()[:, 1])) == 4, "randomize of the YAML"


def test_the_example_trains_as_it_is_shipped(tmp_path: Path) -> None:
    home = tmp_path / "home"
    changes = ["--set", "train.iterations=3", "--set", "train.worlds=16"]
    done = run_muster("run", "job_specs/my-task.yaml", *changes, home=home, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    [run] = Store(home / "store").runs()
    assert [record["iteration"] for record in read_metrics(run)] == [1, 2, 3]
