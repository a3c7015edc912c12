"""Every setting of training that a resumed run is given is applied to what the learner uses, or refused by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from orchestrator.spec.model import ALGORITHMS, Train
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.support.worker.point_task import Point
from tests.support.worker.ranks import training
from tests.support.worker.runs import assert_same_bits, runner, train
from worker.learning import algorithms
from worker.learning.job import configure
from worker.learning.loop import Loop
from worker.learning.ppo.fused import PPO
from worker.settings.errors import UserError
from worker.settings.ppo import PPOConfig


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a run of two iterations, whose learning rate adapted itself."""
    store = tmp_path_factory.mktemp("store")
    train(training(store, iterations=2))
    return store


def go_on(store: Path, **changes: Any) -> Loop:
    return runner(training(store, iterations=4, epoch=2, **changes))


@pytest.fixture(scope="module")
def unchanged(store: Path) -> Loop:
    return go_on(store)


def objective(index: int) -> Callable[[PPO], float]:
    return lambda ppo: ppo._head._numbers[index]


APPLIED: dict[str, tuple[Any, Callable[[PPO], Any]]] = {
    "steps": (4, lambda ppo: len(ppo.rollout.rewards)),
    "epochs": (3, lambda ppo: len(ppo._scratch)),
    "minibatches": (4, lambda ppo: len(ppo._orders) // len(ppo._scratch)),
    "learning_rate": (1e-4, lambda ppo: float(ppo.optimizer.param_groups[0]["lr"])),
    "schedule": ("fixed", lambda ppo: ppo.config.schedule),
    "desired_kl": (0.02, lambda ppo: ppo.config.desired_kl),
    "gamma": (0.9, lambda ppo: ppo.config.gamma),
    "lam": (0.8, lambda ppo: ppo.config.lam),
    "clip": (0.1, objective(0)),
    "clip_values": (False, objective(1)),
    "value_loss_coef": (0.5, objective(2)),
    "entropy_coef": (0.01, objective(3)),
    "learning_rate_limits": ((1e-4, 1e-3), lambda ppo: ppo.config.learning_rate_limits),
    "max_grad_norm": (0.5, lambda ppo: ppo.config.max_grad_norm),
    "learning_rate_horizon": (30, lambda ppo: ppo.config.learning_rate_horizon),
    "min_std": (0.2, lambda ppo: ppo._head._limits[0]),
    "max_std": (2.0, lambda ppo: ppo._head._limits[1]),
    "normalizer_horizon": (5, lambda ppo: ppo.config.normalizer_horizon or 0),
}
"""Of each setting that a resumed run may change: another value, and where the learner has it."""
REFUSED: dict[str, Any] = {
    "hidden_sizes": [8],
    "activation": "tanh",
    "normalize_observations": False,
    "init_std": 0.5,
    "critic_hidden_sizes": [8],
    "critic_observations": "critic",
    "optimizer": "adamw",
    "channels": [16, 32, 16],
    "kernel_sizes": [8, 4, 2],
    "strides": [4, 2, 2],
}
"""Of each setting that it can't change: another value."""


def test_every_setting_is_in_one_of_the_two_tables(unchanged: Loop) -> None:
    refused = {"task", "algorithm", "seed", "config", "worlds"}  # test_refusals.py
    become_settings = {"hyperparameters"}  # of an algorithm, when the job is submitted
    others = {"iterations", "settings", "accept_changed_robot"}
    assert Train.model_fields.keys() == {*refused, *become_settings, *others, *ALGORITHMS}
    assert unchanged.training.iterations == 4, "the run was started with 2"
    names = {item.name for item in dataclasses.fields(PPOConfig)}
    assert names == {*APPLIED, *REFUSED, "weight_decay"}, "which is AdamW's; a run of Adam can't become one of it"
    assert set(PPOConfig.fixed) == REFUSED.keys()


@pytest.mark.parametrize("name", APPLIED)
def test_a_setting_that_is_accepted_is_what_the_learner_uses(store: Path, unchanged: Loop, name: str) -> None:
    value, used = APPLIED[name]
    after = go_on(store, ppo={name: value})
    assert used(unchanged.algorithm) != pytest.approx(value) and used(after.algorithm) == pytest.approx(value)
    assert after.resumed is not None
    assert after.state._manifest()["settings"][name] == pytest.approx(value)


@pytest.mark.parametrize("name", REFUSED)
def test_a_setting_that_the_network_holds_is_refused(store: Path, name: str) -> None:
    with pytest.raises(UserError, match=rf"ppo\.{name} is .* there and .* here; start a new run for that"):
        go_on(store, ppo={name: REFUSED[name]})


def test_a_fixed_rate_is_the_rate_of_every_iteration_and_of_the_manifest(tmp_path: Path) -> None:
    train(training(tmp_path, iterations=2))
    resumed = train(training(tmp_path, iterations=4, epoch=2, ppo={"schedule": "fixed", "learning_rate": 2e-4}))
    assert float(resumed.algorithm._rate) == pytest.approx(2e-4)
    manifest = list_checkpoints(Store(tmp_path).run("run"))[-1].manifest
    assert manifest["learning_rate"] == pytest.approx(2e-4) and manifest["settings"]["schedule"] == "fixed"


def test_an_adapted_rate_goes_on_unless_the_setting_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(training(tmp_path, iterations=2))
    (saved,) = list_checkpoints(Store(tmp_path).run("run"))
    adapted = saved.manifest["learning_rate"]
    assert adapted != pytest.approx(1e-3), "it was adapted"
    kept = go_on(tmp_path)
    assert float(kept.algorithm._rate) == torch.tensor(adapted) and not kept.state.set_anew
    # the task's own rate, now that it is asked for
    assert float(go_on(tmp_path, ppo={"learning_rate": 1e-3}).algorithm._rate) == pytest.approx(1e-3)
    changed = train(training(tmp_path, iterations=3, epoch=2, ppo={"learning_rate": 1e-4}))
    assert "learning rate set to 0.0001" in capsys.readouterr().out
    assert changed.state.learning_rate is not None and changed.state.learning_rate < 5e-4
    again = runner(training(tmp_path, iterations=4, epoch=3, ppo={"learning_rate": 1e-4}))
    assert not again.state.set_anew, "the next attempt of that job goes on with the rate that it has adapted since"


def test_a_run_with_a_fixed_rate_still_ends_with_the_same_bits(tmp_path: Path) -> None:
    fixed = {"ppo": {"schedule": "fixed", "learning_rate": 3e-4}}
    train(training(tmp_path, run="straight", iterations=4, **fixed))
    train(training(tmp_path, run="stopped", iterations=2, **fixed))
    train(training(tmp_path, run="stopped", iterations=4, epoch=2, **fixed))
    ends = [list_checkpoints(Store(tmp_path).run(name))[-1].path for name in ("straight", "stopped")]
    assert_same_bits(*ends)


def test_a_task_whose_own_configuration_is_wrong_is_refused_in_one_line() -> None:
    @dataclasses.dataclass(frozen=True)
    class Careless(PPOConfig):
        schedule: str = "linear"

    @dataclasses.dataclass(frozen=True)
    class Config(Point.config_type):
        ppo: PPOConfig = dataclasses.field(default_factory=Careless)

    class Task(Point):
        config_type = Config

    with pytest.raises(UserError) as error:
        algorithms.settings(PPO, "ppo", configure(Task, {}), {})
    assert str(error.value) == "train.ppo.schedule: expected 'adaptive' or 'fixed', found 'linear'"
