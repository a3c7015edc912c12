"""The job YAML as JSON Schema, for editors."""

from __future__ import annotations

from typing import Any

from orchestrator.spec import ALGORITHMS, Spec, known_tasks


def schema() -> dict[str, Any]:
    """JSON Schema of the job YAML, for editors."""
    document = Spec.model_json_schema()
    definitions = document["$defs"]
    definitions["NodeRange"] = {"anyOf": [{"type": "integer", "minimum": 1, "maximum": 250}, definitions["NodeRange"]]}
    definitions["Train"]["properties"]["task"]["examples"] = known_tasks()
    definitions["Train"]["properties"]["algorithm"]["examples"] = list(ALGORITHMS)
    text = {"type": ["string", "number"]}
    definitions["Resources"]["properties"]["memory"] |= text
    definitions["Logs"]["properties"]["limit"] |= {**text, "default": "1GiB"}
    document["properties"]["stall_timeout"] = {**text, "default": "5m", "description": "of one training iteration"}
    document["properties"]["timeout"] = {**text, "description": "of each attempt, such as 2h"}
    document["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    document["title"] = "Muster job"
    return document
