"""What makes a class an algorithm, what a rank says of a job that nobody checked, and what is done before an algorithm is built."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest
import torch

from tests.conftest import REPOSITORY
from tests.support.refusals import refusal
from tests.support.worker.loop import alone
from tests.support.worker.plain_ppo import PlainPPO
from tests.support.worker.point_task import Point, PointConfig
from worker.learning import algorithms
from worker.learning.algorithm import WorldShare
from worker.learning.algorithms import (
    check_actions,
    check_metrics,
    check_names,
    check_state,
    find_algorithm,
    installed,
    settings,
)
from worker.learning.job import Job
from worker.learning.setup import build_algorithm
from worker.settings.errors import UserError

HERE = "tests.unit.worker.test_algorithms"


class OnlyLearns:
    """Has a few of the parts."""

    config_type, captures_rollout = PointConfig, False

    def learn(self) -> None: ...
    def policy(self) -> None: ...
    def state_dict(self) -> None: ...


class Forgetful(PlainPPO):
    """Has all methods, and does not say how many steps an iteration has."""

    def __init__(self, config: Any, setting: Any) -> None:
        pass


@pytest.mark.parametrize("name", installed())
def test_the_installed_algorithms_satisfy_the_protocol(name: str) -> None:
    assert find_algorithm(name)


def test_an_incomplete_algorithm_is_refused_with_its_missing_members() -> None:
    lacks = "begin, act, record, load_state_dict, world_state, load_world_state, build_policy"
    with pytest.raises(
        UserError, match=rf"^train.algorithm: {HERE}:OnlyLearns is not an algorithm: it lacks {lacks} \("
    ):
        find_algorithm(f"{HERE}:OnlyLearns")


class WithoutPolicy(OnlyLearns):
    config_type = dict

    def state_dict(self) -> Any:
        return {"weights": torch.ones(1)}


def test_a_mistake_of_a_user_s_algorithm_is_reported_in_one_line() -> None:
    with pytest.raises(UserError, match=r'^train\.algorithm: own:A: state_dict\(\) must hold "policy"'):
        check_state(WithoutPolicy(), "own:A")
    with pytest.raises(UserError, match=r"own:A: its config_type must be a dataclass, not dict$"):
        settings(WithoutPolicy, "own:A", PointConfig(), {})
    shape = r"act\(\) must give a tensor of shape \(4, 2\) \(worlds, actions\); it gave \(4,\)$"
    with pytest.raises(UserError, match=shape):
        check_actions(torch.zeros(4), torch.Size((4, 2)), "own:A")
    check_actions(torch.zeros(4, 2), torch.Size((4, 2)), "own:A")
    for metrics, output in (
        (None, "a mapping of metrics, not a NoneType"),
        ({"loss": 0.5}, r"tensors of shape \(\); its metric loss is float"),
        ({"loss": torch.zeros(3)}, r"tensors of shape \(\); its metric loss is \(3,\)"),
    ):
        with pytest.raises(UserError, match=rf"own:A: learn\(\) must give {output}$"):
            check_metrics(metrics, "own:A")
    with pytest.raises(UserError, match=r"own:A: a metric of learn\(\) can't be called reward: every record has one$"):
        check_names(["loss", "reward"], ["reward", "score"], "own:A")


def test_attributes_set_in_the_constructor_are_checked_before_the_first_iteration() -> None:
    chosen = find_algorithm(f"{HERE}:Forgetful")
    with pytest.raises(UserError, match=r"^train.algorithm: Forgetful is not an algorithm: it lacks steps \("):
        build_algorithm(chosen, None, Point(PointConfig(), 2), WorldShare(0, 2, 2), alone(), 0)


ENVIRONMENT = {"MUSTER_STORE": "/store", "MUSTER_RUN": "run"}


def read(train: dict[str, Any], **spec: Any) -> Job:
    return Job.from_env({**ENVIRONMENT, "MUSTER_SPEC": json.dumps({"train": train, **spec})}, "train")


@pytest.mark.parametrize(
    ("train", "output"),
    [
        ({"ppo": 5}, "train.ppo: expected an object, found an integer (5)"),
        ({"algorithm": "sac", "sac": [1]}, "train.sac: expected an object, found a list"),
        ({"algorithm": "my:Mine", "settings": "x"}, "train.settings: expected an object, found a string ('x')"),
        ({"config": True}, "train.config: expected an object, found true or false (True)"),
        ({"algorithm": 5}, "train.algorithm: expected a string, found an integer (5)"),
        ({"algorithm": None}, "train.algorithm: expected a string, found nothing"),
    ],
)
def test_an_invalid_section_is_refused_in_one_line(train: dict[str, Any], output: str) -> None:
    assert refusal(read, train, error=UserError) == output


def test_an_invalid_section_of_the_spec_is_refused_too() -> None:
    with pytest.raises(UserError, match=r"^checkpoint: expected an object, found an integer \(5\)$"):
        read({"task": "Ant"}, checkpoint=5)
    assert read({"task": "Ant", "ppo": None, "config": {}}, checkpoint=None).section["task"] == "Ant"


@pytest.mark.parametrize("name", [":X", "my_module:", "", "pp", "a b:C", ".:C"])
def test_a_name_of_no_algorithm_is_refused_with_the_known_ones(name: str) -> None:
    assert refusal(find_algorithm, name, error=UserError) == (
        f"train.algorithm: no algorithm is called {name!r}; known: ppo, rsl_rl, sac, and module:Class of your own"
    )


def test_a_class_of_an_earlier_version_is_refused_with_its_replacement() -> None:
    with pytest.raises(UserError, match=r"PlainPPO is no longer part of Muster; .*: set train.algorithm: ppo, with"):
        find_algorithm("worker.learning.plain_ppo:PlainPPO")


def test_an_uninstalled_source_tree_has_its_own_algorithms(monkeypatch: pytest.MonkeyPatch) -> None:
    existing = algorithms.installed()
    monkeypatch.setattr(algorithms, "entry_points", lambda group: ())
    assert algorithms.installed() == existing and existing["ppo"] == "worker.learning.ppo.fused:PPO"


def test_settings_import_neither_torch_nor_warp() -> None:
    code = "import sys, worker.settings.ppo, worker.settings.sac, worker.settings.rsl_rl; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY).stdout.split()
    assert "worker.settings.ppo" in loaded
    assert not {"torch", "warp", "numpy", "newton"} & set(loaded)
