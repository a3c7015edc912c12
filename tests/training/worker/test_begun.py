"""A run keeps the settings with which it began, whatever the defaults are by then."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.support.worker.clones import make_clone
from tests.support.worker.ranks import training
from tests.support.worker.runs import assert_same_bits, last, runner, train
from worker.settings.ppo import PPOConfig

THEN = {**PPOConfig.before, "init_std": 0.05}
"""With so small a deviation today's floor would be seen at once."""


def age(store: Path, run: str, settings: dict[str, Any]) -> None:
    """Make the run one of a version that had none of the settings in ``before``, and other defaults of some."""
    for checkpoint in list_checkpoints(Store(store).run(run)):
        path = checkpoint.path / "manifest.json"
        manifest = json.loads(path.read_text())
        manifest["settings"] = {
            key: value for key, value in manifest["settings"].items() if key not in PPOConfig.before
        }
        manifest["train"]["ppo"] = {key: value for key, value in settings.items() if key not in PPOConfig.before}
        path.write_text(json.dumps(manifest))


def settings_of(store: Path, run: str) -> dict[str, Any]:
    settings: dict[str, Any] = list_checkpoints(Store(store).run(run))[-1].manifest["settings"]
    return settings


def test_a_run_begun_before_limits_existed_resumes_with_the_same_bits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(training(tmp_path, run="straight", iterations=6, ppo=THEN))
    train(training(tmp_path, run="stopped", iterations=3, ppo=THEN))
    age(tmp_path, "stopped", THEN)
    capsys.readouterr()
    now = {"init_std": 0.05}
    train(training(tmp_path, run="stopped", iterations=6, epoch=2, ppo=now))
    line = "settings as when the run began, since the job sets no others: learning_rate_horizon None (now 100), min_std 1e-06 (now 0.1)"
    assert line in capsys.readouterr().out
    assert_same_bits(last(tmp_path, "straight"), last(tmp_path, "stopped"))
    assert settings_of(tmp_path, "stopped").items() >= PPOConfig.before.items()  # the next resume keeps them, too


def test_a_setting_of_the_job_wins_and_a_new_run_has_the_defaults_of_now(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(training(tmp_path, run="run", iterations=2))
    assert settings_of(tmp_path, "run")["min_std"] == PPOConfig().min_std
    assert "settings as when" not in capsys.readouterr().out
    age(tmp_path, "run", {})
    resumed = runner(training(tmp_path, run="run", iterations=4, epoch=2, ppo={"min_std": 0.3}))
    assert resumed.training.settings.std_limits == (0.3, 1e6)
    resumed.close()


def test_defaults_of_a_task_that_changed_since_are_kept_and_those_that_a_job_no_longer_sets_are_not(
    tmp_path: Path,
) -> None:
    train(training(tmp_path, run="run", iterations=2, ppo={"clip": 0.4}))
    path = list_checkpoints(Store(tmp_path).run("run"))[-1].path / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["settings"]["gamma"] = 0.5  # as if the default had been another one
    path.write_text(json.dumps(manifest))
    resumed = runner(training(tmp_path, run="run", iterations=4, epoch=2))
    assert (resumed.algorithm.config.gamma, resumed.algorithm.config.clip) == (0.5, PPOConfig().clip)
    resumed.close()


def test_a_clone_keeps_what_its_weights_depend_on_and_has_the_defaults_of_now_otherwise(tmp_path: Path) -> None:
    train(training(tmp_path, run="taught", iterations=2))
    path = list_checkpoints(Store(tmp_path).run("taught"))[-1].path / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["settings"] |= {"gamma": 0.5, "init_std": 0.7}
    path.write_text(json.dumps(manifest))
    make_clone(tmp_path, "clone", "taught")
    clone = runner(training(tmp_path, run="clone", iterations=2))
    assert clone.adopted is not None
    assert (clone.algorithm.config.gamma, clone.algorithm.config.init_std) == (PPOConfig().gamma, 0.7)
    clone.close()
