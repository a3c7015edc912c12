"""A submission refuses what the rank would refuse of an algorithm's settings and the task's own together, and nothing else."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import SpecError
from orchestrator.spec.file import load
from orchestrator.spec.model import ALGORITHMS, validate
from tests.support.refusals import refusal
from tests.support.waiting import PATIENCE
from worker.learning.algorithms import find_algorithm, installed
from worker.learning.algorithms import settings as settings_of
from worker.settings.cartpole import CartpoleConfig
from worker.settings.errors import UserError

WRONG = {
    "Ant ppo learning_rate_limits: [0.1, 0.001]": "learning_rate_limits: expected the least, then the greatest",
    "Ant ppo weight_decay: 0.1": "weight_decay: adam has none; set optimizer: adamw",
    "CartpolePixels ppo channels: [8, 8]": (
        "channels, kernel_sizes and strides: give one number of each for every convolution"
    ),
    "Ant sac updates: 3": "updates: expected a multiple of policy_delay (2), got 3",
    # the task's own 8 updates
    "Cartpole sac policy_delay: 3": "updates: expected a multiple of policy_delay (3), got 8",
    "Cartpole sac v_min: 9.0": "v_min: expected less than v_max (5), got 9",
    "CartpolePixels sac updates: 8": "it can't learn from images, and observation group 'policy' is one; use ppo",
    "Ant sac critic_group: critics": "critic_group: there is no observation group 'critics'; available: policy, critic",
    "Ant rsl_rl obs_groups: {critic: [critics]}": (
        "obs_groups: critic: there is no observation group 'critics'; available: policy, critic"
    ),
    "Ant rsl_rl algorithm: {class_name: Distillation}": "teacher_checkpoint: name the run that trained the teacher",
    "Ant rsl_rl teacher_checkpoint: taught@3": "teacher_checkpoint: PPO has no teacher; leave it out",
}
"""Task, algorithm and settings: the message about them."""


def job(path: Path, task: str, algorithm: str, settings: str) -> str:
    file = path / "job.yaml"
    file.write_text(
        f"name: a\ntrain:\n  task: {task}\n  worlds: 4\n  iterations: 2\n  algorithm: {algorithm}\n"
        f"  {algorithm}:\n    {settings}\n"
    )
    return str(file)


@pytest.mark.parametrize(
    ("algorithm", "key", "value", "output"),
    [
        ("ppo", "hidden_sizes", [], "hidden_sizes: expected at least one number, found []"),
        ("ppo", "epochs", 2.5, "epochs: expected an integer, found a number (2.5)"),
        ("ppo", "schedule", "linear", "schedule: expected 'adaptive' or 'fixed', found 'linear'"),
        ("sac", "gamma", 2.0, "gamma: expected a value less than or equal to 1, found 2.0"),
        ("rsl_rl", "actor", [64], "actor: expected an object, found a list"),
        ("rsl_rl", "actor", {"init": math.inf}, "actor.init: expected a finite number, found a number (inf)"),
        ("rsl_rl", "algorithm", {"max_grad_norm": None}, "algorithm.max_grad_norm: expected a number, found nothing"),
        (
            *("rsl_rl", "algorithm", {"num_mini_batches": 2.5}),
            "algorithm.num_mini_batches: expected an integer, found a number (2.5)",
        ),
    ],
)
def test_submission_and_rank_refuse_a_setting_in_the_same_words(
    algorithm: str, key: str, value: Any, output: str
) -> None:
    section = {"task": "Cartpole", "worlds": 8, "iterations": 1, "algorithm": algorithm, algorithm: {key: value}}
    submission = refusal(validate, {"name": "job", "train": section}, "job.yaml", error=SpecError)
    rank = refusal(settings_of, find_algorithm(algorithm), algorithm, CartpoleConfig(), section, error=UserError)
    assert (rank, submission) == (f"train.{algorithm}.{output}", f"job.yaml: {rank}")


@pytest.mark.parametrize("case", WRONG)
def test_rules_over_several_settings_are_refused_with_file_line_and_key(tmp_path: Path, case: str) -> None:
    (task, algorithm, settings), output = case.split(" ", 2), WRONG[case]
    path = job(tmp_path, task, algorithm, settings)
    key = f"train.{algorithm}" + ("." if output.partition(":")[0].isidentifier() else ": ")
    supplied = settings.partition(":")[0] == output.partition(":")[0]
    assert refusal(load, path, error=SpecError) == f"{path}:{8 if supplied else 7}: {key}{output}"


def test_settings_of_the_job_override_those_of_the_task(tmp_path: Path) -> None:
    for task, algorithm, settings in (
        ("Cartpole", "sac", "policy_delay: 3, updates: 9"),
        ("CartpolePixels", "ppo", "channels: [8], kernel_sizes: [3], strides: [1]"),
        ("Ant", "ppo", "weight_decay: 0.1, optimizer: adamw"),
        ("Ant", "rsl_rl", "algorithm: {class_name: Distillation}, teacher_checkpoint: taught"),
        ("Ant", "rsl_rl", "algorithm: {class_name: 'my_module:MyDistillation'}, teacher_checkpoint: taught"),
        ("Ant", "rsl_rl", "algorithm: {class_name: 'my_module:MyDistillation'}"),
    ):
        load(job(tmp_path, task, algorithm, f"{{{settings}}}"))


def test_an_unknown_task_is_left_to_its_rank(tmp_path: Path) -> None:
    for algorithm, settings in (("ppo", "minibatches: 64"), ("sac", "updates: 3"), ("rsl_rl", "obs_groups: {a: [b]}")):
        load(job(tmp_path, "my_task:Task", algorithm, settings))


def test_settings_of_another_algorithm_are_refused_by_their_key(tmp_path: Path) -> None:
    file = tmp_path / "job.yaml"
    text = "name: a\ntrain:\n  task: Ant\n  worlds: 4\n  iterations: 2\n  algorithm: {}\n  {}: {{epochs: 3}}\n"
    for algorithm, section, belongs in (("sac", "ppo", "sac"), ("my_module:Mine", "ppo", "settings")):
        file.write_text(text.format(algorithm, section))
        output = f"train.{section}: the algorithm is {algorithm}, so its settings belong under train.{belongs}"
        assert refusal(load, str(file), error=SpecError) == f"{file}:7: {output}"


HOPPER = {
    "hopper_settings.py": """
from typing import ClassVar
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

@dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True))
class HopConfig:
    hops: int = 3
    fixed: ClassVar[tuple[str, ...]] = ("hops",)
""",
    "hopper.py": """
from hopper_settings import HopConfig
from tests.support.worker.plain_ppo import PlainPPO

class Hop(PlainPPO):
    config_type = HopConfig
""",
    "hopper-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: hopper\nVersion: 1.0\n",
    "hopper-1.0.dist-info/entry_points.txt": (
        "[muster.algorithms]\nhop = hopper:Hop\n[muster.settings]\nhop = hopper_settings:HopConfig\n"
    ),
}
"""An installed package with an algorithm."""
CONTROLLER = """
from orchestrator.domain.errors import SpecError
from orchestrator.spec.model import validate

def submit(**train):
    base = {"task": "Cartpole", "worlds": 1, "iterations": 1, "algorithm": "hop"}
    return validate({"name": "a", "train": {**base, **train}}, "job.yaml").train.overrides()

print(submit(hop={"hops": 4}))
for wrong in ({"hop": {"hopps": 4}}, {"hop": {"hops": "many"}}, {"ppo": {"epochs": 1}}, {"config": {"hop": {}}}):
    try:
        submit(**wrong)
    except SpecError as error:
        print(error)
"""


def test_an_algorithm_of_an_installed_package_is_known_to_the_submission_and_to_the_rank(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in HOPPER.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    # what is installed is known from the start of a controller on
    command, env = [sys.executable, "-c", CONTROLLER], {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300 * PATIENCE)
    assert done.stdout.splitlines() == [
        "{'hops': 4}",
        "job.yaml: train.hop.hopps: unknown key; did you mean hops?",
        "job.yaml: train.hop.hops: expected an integer, found a string ('many')",
        "job.yaml: train.ppo: the algorithm is hop, so its settings belong under train.hop",
        "job.yaml: train.config.hop: not a key of CartpoleConfig; settings of hop stand under train.hop",
    ], done.stderr
    monkeypatch.syspath_prepend(str(tmp_path))
    found = find_algorithm("hop")
    section = {"algorithm": "hop", "hop": {"hops": 4}}
    assert (found.__name__, settings_of(found, "hop", CartpoleConfig(), section).hops) == ("Hop", 4)


def test_every_installed_algorithm_names_its_class_and_its_settings() -> None:
    assert installed().keys() == ALGORITHMS.keys()
    assert all(find_algorithm(name).config_type is ALGORITHMS[name] for name in ALGORITHMS)
