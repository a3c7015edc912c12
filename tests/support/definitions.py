"""Job definitions as requests of AWS Batch have them, with what a test does not care about filled in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from orchestrator.spec.model import Spec

NEEDS = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "64"}]


def container(
    command: Sequence[str] = ("true",), cpus: str = "0.1", env: Mapping[str, str] | None = None, **more: Any
) -> dict[str, Any]:
    """The properties of a container."""
    return {
        "image": "muster",
        "command": list(command),
        "environment": [{"name": name, "value": value} for name, value in (env or {}).items()],
        "resourceRequirements": [{"type": "VCPU", "value": cpus}, NEEDS[1]],
        **more,
    }


def nodes_of(container: Mapping[str, Any], nodes: int = 1) -> dict[str, Any]:
    """The ``nodeProperties`` of a gang of equal nodes."""
    return {"numNodes": nodes, "mainNode": 0, "nodeRangeProperties": [{"targetNodes": "0:", "container": container}]}


def multinode(name: str, container: Mapping[str, Any], nodes: int = 1, **more: Any) -> dict[str, Any]:
    """RegisterJobDefinition of a gang of equal nodes."""
    return {"jobDefinitionName": name, "type": "multinode", "nodeProperties": nodes_of(container, nodes), **more}


def single(name: str, container: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """RegisterJobDefinition of a job of one container."""
    return {"jobDefinitionName": name, "type": "container", "containerProperties": container, **more}


def submission_of(spec: Spec, definition: str) -> dict[str, Any]:
    """SubmitJob of a job YAML whose definition (name or ARN) a client of AWS's API has registered."""
    share = {"shareIdentifier": spec.share} if spec.share else {}
    return {"jobName": spec.name, "jobQueue": spec.queue, "jobDefinition": definition, **share}
