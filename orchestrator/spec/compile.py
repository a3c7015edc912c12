"""Compiles a spec to the job definition of AWS Batch that carries it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from orchestrator.spec.model import Spec
from shared_store.contract import plugins
from shared_store.volume.texts import beside

_MODULES = {
    **{kind: f"worker.{kind}" for kind in ("train", "evaluate", "export", "record", "render")},
    **{key: section.rank for key, section in plugins.sections().items()},
}
"""The module that each rank of a kind of jobs runs."""


def compile_definition(spec: Spec, directory: str) -> dict[str, Any]:
    """The ``RegisterJobDefinition`` request of a spec, in which the digests of long texts stand (:func:`long_texts`).

    Args:
        spec: The job.
        directory: Directory from which the job was submitted: the working directory of its command, if it exists on the nodes.
    """
    module = _MODULES.get(spec.kind)
    command = ["python", "-P", "-m", module] if module else list(spec.command or [])
    document, _ = beside(spec.document())
    ours = {
        "MUSTER_SPEC": json.dumps(document, separators=(",", ":")),
        "MUSTER_ON_CHILD_FAILURE": spec.on_child_failure,
        "MUSTER_RANKS_PER_NODE": str(spec.ranks_per_node),
        "MUSTER_MIN_NODES": str(spec.nodes.min),
        "MUSTER_DIRECTORY": directory,
        "MUSTER_LOG_LIMIT": str(spec.logs.limit),
    }
    if spec.train:
        ours["MUSTER_STALL_TIMEOUT"] = f"{spec.stall_timeout:g}"
    if spec.preemptible:
        ours["MUSTER_PREEMPTIBLE"] = "1"
    resources = {"VCPU": f"{spec.resources.cpus:g}", "MEMORY": str(spec.resources.memory)}
    if spec.resources.gpus:
        resources["GPU"] = str(spec.resources.gpus)
    container: dict[str, Any] = {
        "image": spec.image,
        "command": command,
        "environment": [{"name": name, "value": value} for name, value in {**spec.environment, **ours}.items()],
        "resourceRequirements": [{"type": kind, "value": value} for kind, value in resources.items()],
    }
    if spec.secrets:
        container["secrets"] = [{"name": name, "valueFrom": reference} for name, reference in spec.secrets.items()]
    request: dict[str, Any] = {
        "jobDefinitionName": spec.name,
        "type": "multinode",
        "nodeProperties": {
            "numNodes": spec.nodes.max,
            "mainNode": 0,
            "nodeRangeProperties": [{"targetNodes": "0:", "container": container}],
        },
        "retryStrategy": {"attempts": spec.retry.attempts},
    }
    if module:  # its exit code 2 is a user's error: another attempt would only repeat it
        request["retryStrategy"]["evaluateOnExit"] = [{"onExitCode": "2", "action": "EXIT"}]
    if spec.priority:
        request["schedulingPriority"] = spec.priority
    if spec.timeout is not None:
        request["timeout"] = {"attemptDurationSeconds": int(spec.timeout)}
    return request


def long_texts(spec: Spec) -> list[str]:
    """The texts of a spec that the store has to keep before its definition is registered (:mod:`shared_store.volume.texts`)."""
    return list(beside(spec.document())[1].values())


def with_environment(properties: Mapping[str, Any], environment: Mapping[str, str]) -> dict[str, Any]:
    """Node properties of :func:`compile_definition` with variables added on every node: the run that is continued, say."""
    ranges = []
    for entry in properties["nodeRangeProperties"]:
        merged = {each["name"]: each["value"] for each in entry["container"]["environment"]} | dict(environment)
        pairs = [{"name": name, "value": value} for name, value in merged.items()]
        ranges.append({**entry, "container": {**entry["container"], "environment": pairs}})
    return {**properties, "nodeRangeProperties": ranges}
