"""The job YAML as JSON Schema, for editors; and the policy contract."""

from __future__ import annotations

from typing import Any

from pydantic import PydanticUserError, TypeAdapter

from orchestrator.domain.gang import MOST_NODES
from orchestrator.spec.model import ALGORITHMS, Spec
from orchestrator.spec.settings import task_config
from orchestrator.spec.tracking_services import track_schema
from orchestrator.spec.values import known_tasks
from shared_store.contract.policy import Contract

_DRAFT = "https://json-schema.org/draft/2020-12/schema"


def schema() -> dict[str, Any]:
    """JSON Schema of the job YAML, for editors."""
    document = Spec.model_json_schema()
    definitions = document["$defs"]
    definitions["NodeRange"] = {
        "anyOf": [{"type": "integer", "minimum": 1, "maximum": MOST_NODES}, definitions["NodeRange"]]
    }
    definitions["TrackingServices"] = track_schema(definitions["TrackingServices"])
    definitions["Train"]["properties"]["task"]["examples"] = known_tasks()
    definitions["Train"]["properties"]["algorithm"]["examples"] = list(ALGORITHMS)
    text = {"type": ["string", "number"]}
    definitions["Resources"]["properties"]["memory"] |= text
    definitions["Logs"]["properties"]["limit"] |= {**text, "default": "1GiB"}
    document["properties"]["stall_timeout"] = {**text, "default": "5m", "description": "of one training iteration"}
    document["properties"]["timeout"] = {**text, "description": "of each attempt, such as 2h"}
    _add_tasks(definitions)
    document["$schema"] = _DRAFT
    document["title"] = "Muster job"
    return document


def contract_schema() -> dict[str, Any]:
    """JSON Schema of a policy contract, as ``contract.json`` holds it."""
    document = TypeAdapter(Contract).json_schema()
    return {"$schema": _DRAFT, **document, "title": "Muster policy contract"}


def _add_tasks(definitions: dict[str, Any]) -> None:
    """Describe ``train.config`` for each installed task that declares its configuration."""
    definitions["Train"]["allOf"] = []
    for task in known_tasks():
        if (kind := task_config(task)) is None:
            continue
        try:
            config = TypeAdapter(kind).json_schema(ref_template=f"#/$defs/{task}_{{model}}")
        except PydanticUserError:  # a type of a user's class that JSON does not have
            continue
        definitions |= {f"{task}_{name}": each for name, each in config.pop("$defs", {}).items()}
        condition = {"properties": {"task": {"const": task}}, "required": ["task"]}
        definitions["Train"]["allOf"].append({"if": condition, "then": {"properties": {"config": config}}})
