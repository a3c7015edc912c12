"""What makes a class an algorithm, and what is done before one is built."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
import warp

from tests.conftest import REPOSITORY
from tests.support.worker.loop import alone
from tests.support.worker.point_task import Point, PointConfig
from worker.distributed import Gang
from worker.errors import UserError
from worker.learning.algorithm import Share
from worker.learning.algorithms import (
    check_actions,
    check_metrics,
    check_names,
    check_state,
    find_algorithm,
    installed,
    settings,
)
from worker.learning.plain_ppo import PlainPPO
from worker.learning.ppo import draws, objective
from worker.learning.sac import kernels
from worker.learning.setup import build_algorithm, load_kernels

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
    with pytest.raises(UserError, match=rf"^train.algorithm: {HERE}:OnlyLearns is no algorithm: it lacks {lacks} \("):
        find_algorithm(f"{HERE}:OnlyLearns")


class WithoutPolicy(OnlyLearns):
    config_type = dict

    def state_dict(self) -> Any:
        return {"weights": torch.ones(1)}


def test_a_mistake_of_a_user_s_algorithm_is_reported_in_one_line() -> None:
    with pytest.raises(UserError, match=r'^train\.algorithm: own:A: state_dict\(\) must hold "policy"'):
        check_state(WithoutPolicy(), "own:A")  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"own:A: its config_type must be a dataclass, not dict$"):
        settings(WithoutPolicy, "own:A", PointConfig(), {})  # type: ignore[arg-type]
    with pytest.raises(
        UserError, match=r"act\(\) must give a tensor of shape \(4, 2\) \(worlds, actions\); it gave \(4,\)$"
    ):
        check_actions(torch.zeros(4), torch.Size((4, 2)), "own:A")
    check_actions(torch.zeros(4, 2), torch.Size((4, 2)), "own:A")
    for metrics, said in (
        (None, "a mapping of metrics, not a NoneType"),
        ({"loss": 0.5}, r"tensors of shape \(\); its metric loss is float"),
        ({"loss": torch.zeros(3)}, r"tensors of shape \(\); its metric loss is \(3,\)"),
    ):
        with pytest.raises(UserError, match=rf"own:A: learn\(\) must give {said}$"):
            check_metrics(metrics, "own:A")
    with pytest.raises(UserError, match=r"own:A: a metric of learn\(\) can't be called reward: every record has one$"):
        check_names(["loss", "reward"], ["reward", "score"], "own:A")


def test_attributes_set_in_the_constructor_are_checked_before_the_first_iteration() -> None:
    chosen = find_algorithm(f"{HERE}:Forgetful")
    with pytest.raises(UserError, match=r"^train.algorithm: Forgetful is no algorithm: it lacks steps \("):
        build_algorithm(chosen, None, Point(PointConfig(), 2), Share(0, 2, 2), alone(), 0)  # type: ignore[arg-type]


class InTurn(Gang):
    """Notes when it is this rank's turn to compile."""

    def __init__(self) -> None:
        vars(self).update(vars(alone()))
        self.turn: str | None = None

    @contextlib.contextmanager
    def build_in_turn(self, warm: Any = None, what: str = "task") -> Iterator[None]:
        self.turn = what
        yield
        self.turn = None


@pytest.mark.parametrize(("name", "modules"), [("ppo", (draws, objective)), ("sac", (kernels,)), ("rsl_rl", ())])
def test_kernels_are_compiled_by_one_rank_of_a_host_and_only_those_of_the_algorithm(
    monkeypatch: pytest.MonkeyPatch, name: str, modules: tuple[Any, ...]
) -> None:
    gang, loaded = InTurn(), []
    monkeypatch.setattr(warp, "load_module", lambda module, device: loaded.append((module, device, gang.turn)))
    load_kernels(find_algorithm(name), gang)
    assert loaded == [(module, "cpu", "algorithm") for module in modules]


def test_the_common_modules_import_no_algorithm() -> None:
    told = "import sys, worker.learning.setup as s; sys.exit(any(n.startswith('worker.learning.ppo.d') for n in sys.modules))"
    assert subprocess.run([sys.executable, "-c", told], cwd=REPOSITORY).returncode == 0
