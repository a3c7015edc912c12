"""DeepRacer's hyperparameters in a job's YAML: which settings they become, the notes on them, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import SpecError
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.file import load
from orchestrator.spec.json_schema import schema
from orchestrator.spec.model import Spec, validate
from tests.support.refusals import refusal

USUAL = {
    **{"batch_size": 64, "beta_entropy": 0.01, "discount_factor": 0.99, "e_greedy_value": 0.05, "epsilon_steps": 10000},
    **{"exploration_type": "categorical", "loss_type": "huber", "lr": 0.0003, "num_episodes_between_training": 20},
    **{"num_epochs": 5, "stack_size": 1, "term_cond_avg_score": 350.0, "term_cond_max_episodes": 1000},
    "sac_alpha": 0.2,
}
"""A file as DeepRacer has it when nothing was changed."""


def job(hyperparameters: Any, task: str = "Racer", **train: Any) -> Spec:
    section = {"task": task, "worlds": 128, "iterations": 2, "hyperparameters": hyperparameters, **train}
    return validate({"name": "racer", "train": section}, "racer.yaml")


def refused(hyperparameters: Any, task: str = "Racer", **train: Any) -> str:
    found = refusal(job, hyperparameters, task, **train, error=SpecError)
    return found.removeprefix("racer.yaml: train.hyperparameters")


def test_a_usual_file_becomes_settings_of_ppo() -> None:
    spec = job(USUAL)
    assert spec.train is not None
    assert spec.train.overrides() == {
        **{"epochs": 5, "learning_rate": 0.0003, "schedule": "fixed", "gamma": 0.99, "entropy_coef": 0.01},
        # 20 episodes of 200 steps are 4,000 steps, 31.25 of each of 128 cars: 32, in eights
        "steps": 32,
        # 4,096 steps in parts of 64 were 64 parts, more than the steps of a world
        "minibatches": 32,
    }
    output = {note.split()[0]: note for note in spec.notes}
    assert output["hyperparameters.batch_size"].endswith(
        "64: a minibatch of each rank has 128 steps, since it has equally many of each world"
    )
    unused = {"e_greedy_value", "epsilon_steps", "term_cond_avg_score", "term_cond_max_episodes", "sac_alpha"}
    close = {"batch_size", "loss_type", "num_episodes_between_training"}
    assert output.keys() == {f"hyperparameters.{name}" for name in unused | close}


OF_SAC = {
    **{"lr": 0.0003, "discount_factor": 0.999, "batch_size": 64, "loss_type": "mean squared error"},
    **{"exploration_type": "additive_noise", "sac_alpha": 0.2},
}
"""A file of a SAC model, as AWS's console exported it."""


def test_a_file_of_sac_is_taken_and_noted_where_ppo_trains() -> None:
    spec = job({**OF_SAC, "e_greedy_value": 0.05, "stack_size": 1, "pretrained": "false"}, algorithm="sac")
    rates = dict.fromkeys(("actor_learning_rate", "critic_learning_rate", "temperature_learning_rate"), 0.0003)
    assert spec.train is not None
    assert spec.train.overrides() == {"batch_size": 64, "gamma": 0.999, "init_temperature": 0.2, **rates}
    assert [note for note in spec.notes if "exploration_type" in note] == []
    assert "hyperparameters.pretrained false: it changes nothing, as on AWS, which does not know it" in spec.notes
    notes = job(OF_SAC).notes
    assert any(note.startswith("hyperparameters.sac_alpha 0.2: it is not used by ppo") for note in notes)
    assert any(note.endswith("a file of SAC wants train.algorithm: sac") for note in notes)


@pytest.mark.parametrize(
    ("worlds", "episodes", "batch", "steps", "minibatches"),
    [
        (16, 1, 512, 16, 1),  # 200 steps are 12.5 of each car, and 16 at least; 256 steps have no part of 512
        (16, 10, 128, 128, 16),  # 2,000 steps are 125 of each; 2,048 / 128
        (4096, 100, 512, 16, 16),  # 20,000 steps are 4.9 of each
        (1, 100, 64, 256, 4),  # 20,000 are more than 256
    ],
)
def test_an_iteration_is_about_as_long_as_that_many_episodes(
    worlds: int, episodes: int, batch: int, steps: int, minibatches: int
) -> None:
    spec = job({"batch_size": batch, "num_episodes_between_training": episodes}, worlds=worlds)
    assert spec.train is not None and spec.train.overrides() == {"steps": steps, "minibatches": minibatches}


def test_a_stack_is_the_frames_of_the_camera() -> None:
    spec = job({"stack_size": 3}, "RacerPixels", config={"front": {"width": 64}})
    assert spec.train is not None and spec.train.config == {"front": {"width": 64, "frames": 3}}


DRAWS = ".exploration_type: ppo and sac draw actions from the policy itself; use categorical"


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"lr": 1}, ".lr: expected a number from 1e-08 to 0.001, found 1"),
        ({"lr": "fast"}, ".lr: expected a number from 1e-08 to 0.001, found 'fast'"),
        ({"lr": None}, ".lr: expected a number from 1e-08 to 0.001, found None"),
        ({"lrr": 1e-4}, ".lrr: DeepRacer has no such hyperparameter; did you mean lr?"),
        ({"lerning_rate": 1e-4}, ".lerning_rate: DeepRacer has no such hyperparameter; did you mean lr?"),
        ({"batch_size": 63}, ".batch_size: expected one of 32, 64, 128, 256, 512, found 63"),
        ({"num_epochs": 2}, ".num_epochs: expected an integer from 3 to 10, found 2"),
        ({"num_epochs": 5.5}, ".num_epochs: expected an integer from 3 to 10, found 5.5"),
        ({"discount_factor": True}, ".discount_factor: expected a number from 0 to 1, found True"),
        ({"loss_type": "mse"}, ".loss_type: expected one of huber, mean squared error, found 'mse'"),
        ({"exploration_type": "e-greedy"}, DRAWS),
        ({"stack_size": 2}, ".stack_size: it stacks images, and the task sees none; use task RacerPixels, or 1"),
        ([1], ": "),
        ("hyperparameters.json", ": a file is read for a job YAML alone; write its settings out"),
    ],
)
def test_an_unusable_hyperparameter_is_refused_in_one_line(fields: Any, words: str) -> None:
    found = refused(fields)
    assert found.startswith(words) and "\n" not in found


def test_a_hyperparameter_that_is_also_a_setting_is_refused() -> None:
    assert refused({"lr": 1e-4}, ppo={"learning_rate": 1e-3}) == (
        ".lr: it is train.ppo.learning_rate here, which is given, too; leave one of them out"
    )
    spec = job({"lr": 1e-4}, ppo={"clip": 0.1})
    assert spec.train is not None
    assert spec.train.overrides() == {"clip": 0.1, "learning_rate": 1e-4, "schedule": "fixed"}


def test_tasks_and_algorithms_without_hyperparameters_refuse_them() -> None:
    assert refused({"lr": 1e-4}, "Ant") == ": AntConfig has none; settings of PPO stand under train.ppo"
    assert refused({"lr": 1e-4}, "mine:Task").startswith(": task 'mine:Task' is not installed, so they are not known")
    assert refused({"lr": 1e-4}, algorithm="rsl_rl").startswith(": they are settings of ppo and sac")


def test_a_file_of_hyperparameters_is_read_at_the_submission_and_not_needed_again(tmp_path: Path) -> None:
    file, yaml = tmp_path / "hyperparameters.json", tmp_path / "racer.yaml"
    file.write_text(json.dumps({"lr": "0.0002", "loss_type": "mean_squared_error"}))
    yaml.write_text(f"name: racer\ntrain:\n  task: Racer\n  worlds: 8\n  iterations: 1\n  hyperparameters: {file}\n")
    spec = load(str(yaml))
    assert spec.train is not None and spec.train.overrides() == {"learning_rate": 0.0002, "schedule": "fixed"}
    assert spec.notes == ()
    assert "hyperparameters" not in json.dumps(compile_definition(spec, "/"))
    assert "hyperparameters" in schema()["$defs"]["Train"]["properties"]
    for content, words in (
        ("[", f"racer.yaml:6: train.hyperparameters: {file}: not JSON"),
        ("[1]", f"racer.yaml:6: train.hyperparameters: {file}: not a JSON object"),
        ('{"lr": 2}', "racer.yaml:6: train.hyperparameters.lr: expected a number from 1e-08 to 0.001, found 2"),
        (None, f"racer.yaml:6: train.hyperparameters: {file}: there is no such file"),
    ):
        file.unlink()
        if content is not None:
            file.write_text(content)
        assert words in refusal(load, str(yaml), error=SpecError)
