"""The JSON Schema of the job YAML: what editors are told agrees with what is accepted."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from orchestrator.domain.errors import SpecError
from orchestrator.spec.json_schema import schema
from orchestrator.spec.model import KINDS, Spec, validate
from orchestrator.spec.values import known_tasks

SHIPPED = sorted((Path(__file__).parents[4] / "job_specs").glob("*.yaml"))


@cache
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(schema())


def accepts(document: Any) -> bool:
    return bool(validator().is_valid(document))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_json_schema_accepts_every_shipped_spec(path: Path) -> None:
    assert accepts(yaml.safe_load(path.read_text()))


RIGHT = ["{}", "nodes: 2", "nodes: {min: 1, max: 2}", "timeout: 2h", "timeout: 7200", "resources: {memory: 4GiB}"]
RIGHT += ["environment: {A: b}"]
WRONG = ["nodez: 2", "nodes: 0", "nodes: two", "retry: {attempts: 11}", "on_child_failure: resart"]
WRONG += ["environment: {A: 1}", "command: []", "name: null"]


@pytest.mark.parametrize(("changes", "fine"), [*((each, True) for each in RIGHT), *((each, False) for each in WRONG)])
def test_the_json_schema_tells_right_from_wrong(changes: str, fine: bool) -> None:
    assert accepts({"name": "a", "command": ["x"], **yaml.safe_load(changes)}) == fine


def test_the_json_schema_lists_every_key_and_the_known_tasks() -> None:
    document = schema()
    assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert list(document["properties"]) == list(Spec.model_fields)
    assert set(KINDS) < document["properties"].keys()
    assert document["required"] == ["name"]
    assert document["$defs"]["Train"]["properties"]["task"]["examples"] == known_tasks()
    assert json.loads(json.dumps(document)) == document


RIGHT_CONFIGS = [
    "Ant {}",
    "Ant {fall_height: 0.3, rewards: {up: 1}, curriculum: {level: [[0, 0.5], [9, 1]]}}",
    "Ant {randomize: {mass: [0.9, 1.1], observation_noise: {'*_velocity': 0.1}}}",
    "CartpolePixels {camera: {width: 96}}",
    "Quadruped {command_turn: [-1, 1]}",
    "my_module:Task {anything: 1}",
]
WRONG_CONFIGS = [
    *("Ant {fall_hight: 0.3}", "Ant {fall_height: low}", "Ant {substeps: 0}", "Ant {rewards: {foward: 1}}"),
    *("Ant {curriculum: {foward: [[0, 1]]}}", "Ant {curriculum: {up: [[0]]}}", "Ant {randomize: {mass: [0, 1]}}"),
    *("Ant {camera: {width: 96}}", "Ant {ppo: {steps: 8}}", "CartpolePixels {camera: {width: 0}}"),
]


@pytest.mark.parametrize(
    ("case", "fine"), [*((each, True) for each in RIGHT_CONFIGS), *((each, False) for each in WRONG_CONFIGS)]
)
def test_the_json_schema_knows_the_configuration_of_each_task(case: str, fine: bool) -> None:
    task, config = case.split(" ", 1)[0], yaml.safe_load(case.split(" ", 1)[1])
    document = {"name": "a", "train": {"task": task, "worlds": 1, "iterations": 1, "config": config}}
    assert accepts(document) == fine
    try:
        validate(document, "job.yaml")
        taken = True
    except SpecError:
        taken = False
    assert taken == fine, "as the submission does"


def test_the_json_schema_is_valid() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())
    assert not any("PPO" in name for name in schema()["$defs"]), "how a task is trained has a section of its own"
