"""A task whose actions are choices, from its file to the exported policy: through the real command."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx.reference import ReferenceEvaluator

import worker.train
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import run_muster
from tests.support.worker.in_process import call_worker
from tests.support.worker.ranks import training
from worker.tasks.run.gym import TaskVectorEnv

TASK = '''
import dataclasses

import warp as wp

from worker.tasks import Choice, Reward, RobotArrays, WorldArrays, terms
from worker.tasks.library.cartpole import Cartpole


@wp.func
def push(world: int, worlds: WorldArrays, robot: RobotArrays, choice: int):
    worlds.controls[world, robot.actuators[0]] = 0.6 * float(choice - 1)


class Pushed(Cartpole):
    """The cart is pushed to the left, not at all, or to the right."""

    def declare(self, config):
        declared = super().declare(config)
        # a choice has no size that could cost anything
        rewards = {**declared.rewards, "effort": Reward(terms.joint_velocity_squared, joints="slider")}
        choice = Choice(push, names=("left", "nothing", "right"))
        return dataclasses.replace(declared, actions=choice, rewards=rewards)
'''
JOB = "name: pushed\nresources: {cpus: 1, memory: 1GiB}\ntrain: {task: pushed:Pushed, worlds: 64, iterations: 80}\n"


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "pushed.py").write_text(TASK)
    (tmp_path / "job.yaml").write_text(JOB)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_ppo_learns_to_choose_is_killed_and_exports_what_it_learnt(directory: Path) -> None:
    home = directory / "home"
    options = ("--at", "79", "--iterations", "1", "--set", "checkpoint.every=10")
    done = run_muster("verify-resume", "job.yaml", *options, home=home, cwd=directory, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^equal: \d+ tensors, 80 iterations$", done.stdout, re.M), done.stdout
    run = Store(home / "store").run(re.search(r"^killed: +(\S+),", done.stdout, re.M)[1])
    records = read_metrics(run)
    assert records[0]["reward"] < 8.0 and records[-1]["reward"] > 18.0, "30 is the greatest that there could be"
    assert 0.0 < records[-1]["entropy"] < np.log(3.0)
    (evaluation,) = run.evaluations.glob("*.json")
    assert json.loads(evaluation.read_text())["mean_return"] > 20.0
    (directory / "export.yaml").write_text(f"name: export\nresources: {{memory: 1GiB}}\nexport: {{run: {run.name}}}\n")
    done = run_muster("run", "export.yaml", home=home, cwd=directory, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (exported,) = run.exports.iterdir()
    facts = json.loads((exported / "contract.json").read_text())
    assert facts["discrete"] and facts["action_names"] == ["left", "nothing", "right"]
    leaning = np.array([[0.0, -0.1, 0.0, -0.5], [0.0, 0.1, 0.0, 0.5]], dtype=np.float32)
    (chosen,) = ReferenceEvaluator(onnx.load(exported / "policy.onnx")).run(None, {"obs": leaning})
    assert sorted(chosen[:, 0]) == [0.0, 2.0], "the cart goes under the pole"


@pytest.mark.parametrize(
    ("algorithm", "output"), [("sac", "this task's are choices; use ppo"), ("rsl_rl", "are choices")]
)
def test_who_cannot_choose_says_so_in_one_line(directory: Path, algorithm: str, output: str) -> None:
    reported = training(directory / "store", task="pushed:Pushed", algorithm=algorithm)
    done = call_worker(worker.train.main, reported)
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and line.startswith("error: ") and output in line


def test_gymnasium_sees_choices(directory: Path) -> None:
    environment = TaskVectorEnv("pushed:Pushed", 4)
    assert environment.single_action_space.n == 3
    velocities = []
    for choice in range(3):
        environment.reset(seed=1)
        velocities.append(environment.step(np.full(4, choice))[0][:, 2])
    assert (np.diff(velocities, axis=0) > 0).all(), "of each world's cart: further to the right"
