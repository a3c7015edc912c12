"""Settings of rsl_rl in a job: what is filled in, what is refused."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
from typing import Any

import pytest
import rsl_rl.algorithms

from tests.support.worker.rsl_loop import settings
from worker.settings import rsl_rl_checks as checks
from worker.settings.errors import UserError
from worker.settings.rsl_rl import RslRlConfig


def test_a_section_with_a_class_is_used_unchanged_and_one_without_overrides_the_defaults() -> None:
    supplied = {"class_name": "MLPModel", "hidden_dims": [7]}
    config = settings({"critic": supplied, "actor": {"hidden_dims": [5], "distribution_cfg": {"init_std": 0.3}}})
    assert config.section("critic") == supplied
    normal = {"class_name": "GaussianDistribution", "init_std": 0.3}
    expected = {"class_name": "MLPModel", "hidden_dims": [5], "activation": "elu", "obs_normalization": True}
    assert config.section("actor") == {**expected, "distribution_cfg": normal}
    config.section("actor")["distribution_cfg"]["init_std"] = 9.0
    assert RslRlConfig().section("actor")["distribution_cfg"]["init_std"] == 1.0
    assert json.loads(json.dumps(dataclasses.asdict(config)))["critic"] == supplied


def ppo(**keys: Any) -> dict[str, Any]:
    return {"algorithm": keys}


without_weight = {"num_outputs": 4, "predictor_hidden_dims": [8], "target_hidden_dims": [8]}


def scheduled(**keys: Any) -> dict[str, Any]:
    return {**without_weight, "weight": 0.5, "weight_schedule": keys}


FINITE = r"expected a finite number, found a number \(inf\)$"
WHOLE = r"expected an integer, found a number \(2\.5\)$"
SCHEDULE = r"algorithm\.rnd_cfg\.weight_schedule"


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"max_iterations": 3}, r"max_iterations: there is no such setting; use train\.iterations$"),
        ({"actr": {}}, r"actr: there is no such setting; did you mean actor\?$"),
        ({"num_steps_per_env": 0}, r"num_steps_per_env: expected a value greater than or equal to 1, found 0$"),
        ({"obs_groups": {"actor": "policy"}}, r"obs_groups\.actor: expected a list, found a string"),
        ({"actor": {"distribution_cfg": {"init_std": math.inf}}}, rf"actor\.distribution_cfg\.init_std: {FINITE}"),
        (ppo(class_name="own:PPO", anything=[math.inf]), rf"algorithm\.anything\.0: {FINITE}"),
        (ppo(num_mini_batches=2.5), rf"algorithm\.num_mini_batches: {WHOLE}"),
        (ppo(gamma="99e-2"), r"algorithm\.gamma: .* found a string \('99e-2'\); in YAML it is written 99\.0e-2$"),
        (ppo(class_name=5), r"algorithm\.class_name: expected a string, found 5$"),
        (ppo(rnd_cfg={"weight": 1.0}), r"algorithm\.rnd_cfg\.num_outputs: is required$"),
        (ppo(rnd_cfg=scheduled(mode="cosine")), rf"{SCHEDULE}\.mode: expected constant, step, linear, "),
        (ppo(rnd_cfg=scheduled(mode="step", final_step=3)), rf"{SCHEDULE}\.final_value: is required$"),
        (ppo(num_minibatches=2), r"algorithm\.num_minibatches: there is no such key; did you mean num_mini_batches\?$"),
        (ppo(symmetry_cfg={"mirror": "a:b"}), r"algorithm\.symmetry_cfg\.data_augmentation_func: is required$"),
        (ppo(rnd_cfg=scheduled(mode="constant", steps=3)), rf"{SCHEDULE}\.steps: there is no such key; available:"),
        ({"obs_groups": {"critc": ["policy"]}}, r"obs_groups\.critc: PPO has no such set; did you mean critic\?$"),
        (ppo(class_name="Distillation"), r"teacher_checkpoint: name the run that trained the teacher$"),
        ({"teacher_checkpoint": "taught"}, r"teacher_checkpoint: PPO has no teacher; leave it out$"),
        ({"student": {"hidden_dims": [8]}}, r"student: PPO has the networks actor and critic$"),
        (
            {"num_steps_per_env": 4, **ppo(class_name="Distillation"), "teacher_checkpoint": "taught"},
            r"algorithm\.gradient_length: nothing is learnt in 4 steps an iteration, 15 are needed$",
        ),
    ],
)
def test_settings_that_are_refused(section: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=rf"^train\.rsl_rl\.{message}") as refusal:
        settings(section)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "section",
    [
        {"algorithm": {"class_name": "Distillation"}, "teacher_checkpoint": "taught"},
        {"algorithm": {"class_name": "own:PPO", "num_mini_batches": 2.5}},
        ppo(desired_kl=None, learning_rate=1, symmetry_cfg=None, rnd_cfg=scheduled(mode="constant")),
        ppo(rnd_cfg=scheduled(mode="linear", initial_step=0, final_step=9, final_value=0.0)),
        {"algorithm": {"class_name": "Distillation", "max_grad_norm": None}, "teacher_checkpoint": "taught"},
    ],
)
def test_settings_that_rsl_rl_takes_are_taken(section: dict[str, Any]) -> None:
    assert settings(section).section("algorithm").items() >= section["algorithm"].items()


@pytest.mark.parametrize("kind", ["PPO", "Distillation"])
def test_every_key_that_rsl_rl_s_classes_take_is_known(kind: str) -> None:
    """But for what their runner gives them."""
    taken = set(inspect.signature(getattr(rsl_rl.algorithms, kind)).parameters)
    supplied = {"actor", "critic", "student", "teacher", "storage", "device", "multi_gpu_cfg", "kwargs"}
    known = set(checks._SECTIONS[kind].json_schema()["properties"])
    assert taken - supplied <= known and known - taken <= {"class_name", "share_cnn_encoders"}
