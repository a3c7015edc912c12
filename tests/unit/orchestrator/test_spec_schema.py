"""The JSON Schema of the job YAML: what editors are told agrees with what is accepted."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from orchestrator.spec import KINDS, Spec
from orchestrator.spec_schema import schema
from orchestrator.spec_values import known_tasks

SHIPPED = sorted((Path(__file__).parents[3] / "job_specs").glob("*.yaml"))


def accepts(node: dict[str, Any], value: Any, document: dict[str, Any]) -> bool:
    """Whether a JSON Schema (of the kind that is written here) accepts a value."""
    if "$ref" in node:
        assert node["$ref"].startswith("#/$defs/")
        return accepts(document["$defs"][node["$ref"].removeprefix("#/$defs/")], value, document)
    if "anyOf" in node:
        return any(accepts(each, value, document) for each in node["anyOf"])
    number = isinstance(value, int | float) and not isinstance(value, bool)
    types: dict[str, bool] = {
        "object": isinstance(value, dict),
        "array": isinstance(value, list),
        "string": isinstance(value, str),
        "boolean": isinstance(value, bool),
        "null": value is None,
        "number": number,
        "integer": number and isinstance(value, int),
    }
    wanted = node.get("type", list(types))
    if not any(types[name] for name in ([wanted] if isinstance(wanted, str) else wanted)):
        return False
    if isinstance(value, dict):
        properties = node.get("properties", {})
        additional = node.get("additionalProperties", True)
        return set(node.get("required", [])) <= value.keys() and all(
            accepts(properties[key], each, document)
            if key in properties
            else accepts(additional, each, document)
            if isinstance(additional, dict)
            else additional
            for key, each in value.items()
        )
    if isinstance(value, list):
        return len(value) >= node.get("minItems", 0) and all(accepts(node["items"], each, document) for each in value)
    if number:
        return node.get("minimum", -math.inf) <= value <= node.get("maximum", math.inf) and value > node.get(
            "exclusiveMinimum", -math.inf
        )
    return "enum" not in node or value in node["enum"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_json_schema_accepts_every_shipped_spec(path: Path) -> None:
    assert accepts(schema(), yaml.safe_load(path.read_text()), schema())


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
    assert accepts(schema(), document, schema()) == fine


def test_the_json_schema_lists_every_key_and_the_known_tasks() -> None:
    document = schema()
    assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert list(document["properties"]) == list(Spec.model_fields)
    assert set(KINDS) < document["properties"].keys()
    assert document["required"] == ["name"]
    assert document["$defs"]["Train"]["properties"]["task"]["examples"] == known_tasks()
    assert json.loads(json.dumps(document)) == document
