"""The JSON Schema of the job YAML: what editors are told agrees with what is accepted."""

from __future__ import annotations

import json
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


def accepts(document: Any) -> bool:
    return bool(jsonschema.Draft202012Validator(schema()).is_valid(document))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_json_schema_accepts_every_shipped_spec(path: Path) -> None:
    assert accepts(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize(
    ("changes", "fine"),
    [
        ({}, True),
        ({"nodes": 2}, True),
        ({"nodes": {"min": 1, "max": 2}}, True),
        ({"timeout": "2h"}, True),
        ({"timeout": 7200}, True),
        ({"resources": {"memory": "4GiB"}}, True),
        ({"environment": {"A": "b"}}, True),
        ({"nodez": 2}, False),
        ({"nodes": 0}, False),
        ({"nodes": "two"}, False),
        ({"retry": {"attempts": 11}}, False),
        ({"on_child_failure": "resart"}, False),
        ({"environment": {"A": 1}}, False),
        ({"command": []}, False),
        ({"name": None}, False),
    ],
)
def test_the_json_schema_tells_right_from_wrong(changes: dict[str, Any], fine: bool) -> None:
    document = {"name": "a", "command": ["x"], **changes}
    assert accepts(document) == fine


def test_the_json_schema_lists_every_key_and_the_known_tasks() -> None:
    document = schema()
    assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert list(document["properties"]) == list(Spec.model_fields)
    assert set(KINDS) < document["properties"].keys()
    assert document["required"] == ["name"]
    assert document["$defs"]["Train"]["properties"]["task"]["examples"] == known_tasks()
    assert json.loads(json.dumps(document)) == document


@pytest.mark.parametrize(
    ("task", "config", "fine"),
    [
        ("Ant", {}, True),
        ("Ant", {"fall_height": 0.3, "rewards": {"up": 1}, "curriculum": {"level": [[0, 0.5], [9, 1]]}}, True),
        ("Ant", {"randomize": {"mass": [0.9, 1.1], "observation_noise": {"*_velocity": 0.1}}}, True),
        ("CartpolePixels", {"camera": {"width": 96}}, True),
        ("Quadruped", {"command_turn": [-1, 1]}, True),
        ("my_module:Task", {"anything": 1}, True),
        ("Ant", {"fall_hight": 0.3}, False),
        ("Ant", {"fall_height": "low"}, False),
        ("Ant", {"substeps": 0}, False),
        ("Ant", {"rewards": {"foward": 1}}, False),
        ("Ant", {"curriculum": {"foward": [[0, 1]]}}, False),
        ("Ant", {"curriculum": {"up": [[0]]}}, False),
        ("Ant", {"randomize": {"mass": [0, 1]}}, False),
        ("Ant", {"camera": {"width": 96}}, False),
        ("Ant", {"ppo": {"steps": 8}}, False),
        ("CartpolePixels", {"camera": {"width": 0}}, False),
    ],
)
def test_the_json_schema_knows_the_configuration_of_each_task(task: str, config: dict[str, Any], fine: bool) -> None:
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
