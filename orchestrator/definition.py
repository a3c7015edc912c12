"""From a spec to the AWS Batch requests that carry it, and from a Batch definition to what a gang needs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from orchestrator.scheduling.snapshot import NodeShape, Shape
from orchestrator.spec import Spec
from shared_store.log_files import LIMIT

_MODULES = {kind: f"worker.{kind}" for kind in ("train", "evaluate", "race", "export", "record", "render")}


def compile_definition(spec: Spec, directory: str) -> dict[str, Any]:
    """The ``RegisterJobDefinition`` request of a spec.

    Args:
        spec: The job.
        directory: Where the job was submitted from: the working directory of its command, where the engine has it.
    """
    module = _MODULES.get(spec.kind)
    command = ["python", "-P", "-m", module] if module else list(spec.command or [])
    ours = {
        "MUSTER_SPEC": json.dumps(spec.model_dump(mode="json", exclude_none=True), separators=(",", ":")),
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
    if module:  # its exit code 2 is a user's error, which another attempt would only repeat
        request["retryStrategy"]["evaluateOnExit"] = [{"onExitCode": "2", "action": "EXIT"}]
    if spec.priority:
        request["schedulingPriority"] = spec.priority
    if spec.timeout is not None:
        request["timeout"] = {"attemptDurationSeconds": int(spec.timeout)}
    return request


def compile_submission(
    spec: Spec, definition: str, environment: Mapping[str, str] | None = None, tags: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """The ``SubmitJob`` request of a spec whose definition (ARN) is registered.

    ``environment`` is added on every node: the run that is continued, the checkpoint to start from. ``tags``: of the job.
    """
    request: dict[str, Any] = {"jobName": spec.name, "jobQueue": spec.queue, "jobDefinition": definition}
    if spec.share:
        request["shareIdentifier"] = spec.share
    if tags:
        request["tags"] = dict(tags)
    if environment:
        pairs = [{"name": name, "value": value} for name, value in environment.items()]
        request["nodeOverrides"] = {
            "nodePropertyOverrides": [{"targetNodes": "0:", "containerOverrides": {"environment": pairs}}]
        }
    return request


@dataclass(frozen=True)
class NodeNeeds:
    """What one node runs and takes."""

    command: tuple[str, ...]
    environment: Mapping[str, str]
    cpus: float
    gpus: int
    memory: int
    """MiB."""
    container: Mapping[str, Any]
    """``containerProperties`` as they are."""


@dataclass(frozen=True)
class GangNeeds:
    """What a whole job needs, as read from its Batch definition with the overrides applied."""

    main: int
    nodes: tuple[NodeNeeds, ...]
    """By index."""
    minimum: int
    """With how few nodes it may start; native jobs only."""

    @cached_property
    def shape(self) -> Shape:
        """What the scheduler looks at."""
        nodes = tuple(NodeShape(node.cpus, node.gpus, node.memory) for node in self.nodes)
        return Shape(nodes, self.minimum, self.main)

    def setting(self, name: str, default: str = "") -> str:
        """A ``MUSTER_*`` variable of the main node."""
        return self.nodes[self.main].environment.get(name, default)

    @property
    def spec(self) -> dict[str, Any] | None:
        """The spec that the job was compiled from; None for a job that came through the Batch API."""
        text = self.setting("MUSTER_SPEC")
        spec = json.loads(text) if text else None
        if spec is not None and not isinstance(spec, dict):
            raise ValueError("MUSTER_SPEC is not a mapping")
        return spec

    @property
    def log_limit(self) -> int:
        """Bytes of each node's log that are kept. Raises ValueError."""
        return int(self.setting("MUSTER_LOG_LIMIT") or LIMIT)

    @property
    def is_native(self) -> bool:
        """Whether it came from our YAML, and gets the better defaults; else it behaves as on AWS."""
        return bool(self.setting("MUSTER_ON_CHILD_FAILURE"))

    @property
    def on_child_failure(self) -> str:
        return self.setting("MUSTER_ON_CHILD_FAILURE", "ignore")


def target_nodes(text: str, count: int) -> range:
    """Node indices of ``a:b``, ``:b``, ``a:`` or ``n``, of ``count`` nodes. Raises ValueError."""
    first, colon, last = text.partition(":")
    if not re.fullmatch(r"[0-9]{1,6}|[0-9]{0,6}:[0-9]{0,6}", text):
        raise ValueError(f"targetNodes {text[:20]!r}: expected n, a:b, a: or :b")
    start = int(first or 0)
    stop = (int(last) if last else count - 1) if colon else start
    return range(start, stop + 1)


def gang_needs(node_properties: Mapping[str, Any]) -> GangNeeds:
    """Read ``nodeProperties`` (overrides applied already); of nested ranges the later, inner one counts. Raises ValueError."""
    if not node_properties:
        raise ValueError("nodeProperties are empty: the job's row in the database is damaged")
    count = int(node_properties["numNodes"])
    nodes: list[NodeNeeds | None] = [None] * count
    for entry in sorted(
        node_properties["nodeRangeProperties"], key=lambda e: -len(target_nodes(e["targetNodes"], count))
    ):
        needs = _node_needs(entry.get("container") or {})
        for index in target_nodes(entry["targetNodes"], count):
            if index < count:
                nodes[index] = needs
    missing = [index for index, node in enumerate(nodes) if node is None]
    if missing:
        raise ValueError(
            f"nodeRangeProperties cover no node {missing[0]}; every node from 0 to {count - 1} needs a range"
        )
    main = int(node_properties["mainNode"])
    whole = tuple(node for node in nodes if node is not None)
    minimum = int(whole[main].environment.get("MUSTER_MIN_NODES", count))
    return GangNeeds(main, whole, min(max(minimum, main + 1), count))  # never without the main node


def _node_needs(container: Mapping[str, Any]) -> NodeNeeds:
    resources = {entry["type"]: entry["value"] for entry in container.get("resourceRequirements") or []}
    return NodeNeeds(
        command=tuple(container.get("command") or ()),
        environment={entry["name"]: entry.get("value", "") for entry in container.get("environment") or []},
        cpus=float(resources.get("VCPU", container.get("vcpus", 1))),
        gpus=int(resources.get("GPU", 0)),
        memory=int(resources.get("MEMORY", container.get("memory", 4))),
        container=container,
    )
