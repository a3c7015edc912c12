"""The resources and commands of a gang, as read from an AWS Batch job definition."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from orchestrator.domain.native_options import MalformedOptions, NativeOptions
from orchestrator.domain.resources import Resources
from orchestrator.domain.storable import DEEPEST_SPEC, not_storable

MOST_NODES = 5000
"""Nodes of a gang from YAML; the Batch API takes AWS's 1,000."""
LARGEST_DEFINITION = 24 << 10
"""Bytes of a job definition, as on AWS."""


@dataclass(frozen=True)
class Shape:
    """The resources of a gang; compared by value. Callers share one object between equal jobs, which makes look-ups fast."""

    nodes: tuple[Resources, ...]
    """Resources of each node, by node index."""
    minimum: int
    """The smallest number of nodes (counted from the first) with which it may start."""
    main: int

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.nodes, self.minimum, self.main))

    @cached_property
    def groups(self) -> tuple[tuple[Resources, tuple[int, ...]], ...]:
        """The distinct nodes and their indices, the most demanding first."""
        indices: dict[Resources, list[int]] = {}
        for index, node in enumerate(self.nodes):
            indices.setdefault(node, []).append(index)
        ordered = sorted(indices.items(), key=lambda item: (-item[0].gpus, -item[0].cpus, -item[0].memory))
        return tuple((node, tuple(each)) for node, each in ordered)

    @cached_property
    def uses_gpus(self) -> bool:
        """Whether shares are compared by GPUs; otherwise by CPUs."""
        return any(node.gpus for node in self.nodes)

    @cached_property
    def demand(self) -> float:
        """GPUs of the whole gang; CPUs where it has none."""
        total = sum(self.nodes, Resources())
        return float(total.gpus or total.cpus)

    @cached_property
    def least(self) -> Resources:
        """Total resources of the smallest allowed number of nodes."""
        return sum(self.nodes[: self.minimum], Resources())


FARGATE_MEMBERS = (
    *("networkConfiguration", "fargatePlatformConfiguration", "platformVersion", "ephemeralStorage"),
    "runtimePlatform",
)
"""Members of a container that are for Fargate; no engine reads them."""
LOG_GROUP = "/aws/batch/job"
"""The log group of containers that name none."""


@dataclass(frozen=True)
class NodeSpec:
    """The command and the resources of one node."""

    command: tuple[str, ...]
    environment: Mapping[str, str]
    ranks: int
    """Training processes; 1 where the definition does not say."""
    resources: Resources
    container: Mapping[str, Any]
    """``containerProperties`` unchanged, from which engines read volumes, limits and the like."""
    ecs: str | None = None
    """Name of the container where the definition gave ``ecsProperties``; None where it gave ``container``."""

    @property
    def log_group(self) -> str | None:
        """Its log group; None: :data:`LOG_GROUP`."""
        named = self._log_options.get("awslogs-group")
        return None if named == LOG_GROUP else named

    @property
    def log_prefix(self) -> str | None:
        """The beginning of its stream's name; None: the name of the job."""
        return self._log_options.get("awslogs-stream-prefix") or None

    @property
    def _log_options(self) -> Mapping[str, str]:
        return (self.container.get("logConfiguration") or {}).get("options") or {}

    @cached_property
    def spec(self) -> Mapping[str, Any] | None:
        """The job YAML that the node reads; None where it has none. Raises MalformedOptions."""
        text = self.environment.get("MUSTER_SPEC")
        if not text:
            return None
        try:
            spec = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise MalformedOptions(f"MUSTER_SPEC can't be read: {error}") from None
        if spec is not None and not isinstance(spec, dict):
            raise MalformedOptions("MUSTER_SPEC is not an object")
        if ("\\u" in text or text.count("[") + text.count("{") > DEEPEST_SPEC) and (problem := not_storable(spec)):
            raise MalformedOptions(f"MUSTER_SPEC: {problem[1]}")
        return spec


@dataclass(frozen=True)
class GangSpec:
    """A whole job's Batch definition with the overrides applied; read once and never changed."""

    main: int
    nodes: tuple[NodeSpec, ...]
    """By index; the nodes of a range share one."""
    minimum: int
    """The smallest number of nodes with which it may start; native jobs only."""
    options: NativeOptions

    @cached_property
    def shape(self) -> Shape:
        """The part that the scheduler needs."""
        return Shape(tuple(node.resources for node in self.nodes), self.minimum, self.main)

    @property
    def log_groups(self) -> set[str]:
        """The log groups of its nodes, but for :data:`LOG_GROUP`."""
        return {node.log_group for node in self.nodes if node.log_group}

    @property
    def spec(self) -> Mapping[str, Any] | None:
        """The spec that the job was compiled from; None for a job that came through the Batch API. Raises ValueError."""
        return self.nodes[self.main].spec


def target_nodes(text: str, count: int) -> range:
    """Node indices of ``a:b``, ``:b``, ``a:`` or ``n``, of ``count`` nodes. Raises ValueError."""
    first, colon, last = text.partition(":")
    if not re.fullmatch(r"[0-9]{1,6}|[0-9]{0,6}:[0-9]{0,6}", text):
        raise ValueError(f"targetNodes {text[:20]!r}: expected n, a:b, a: or :b")
    start = int(first or 0)
    stop = (int(last) if last else count - 1) if colon else start
    return range(start, stop + 1)


def gang_needs(node_properties: Mapping[str, Any]) -> GangSpec:
    """Read ``nodeProperties`` (overrides applied already); of nested ranges the later, inner one counts. Raises ValueError.

    Of a job that is stored, :attr:`orchestrator.persistence.batch_models.Job.gang` has what this read.
    """
    if not node_properties:
        raise ValueError("nodeProperties are empty: the job's row in the database is damaged")
    count = int(node_properties["numNodes"])
    nodes: list[NodeSpec | None] = [None] * count
    for entry in sorted(
        node_properties["nodeRangeProperties"], key=lambda e: -len(target_nodes(e["targetNodes"], count))
    ):
        node = _node_spec(entry)
        for index in target_nodes(entry["targetNodes"], count):
            if index < count:
                nodes[index] = node
    missing = [index for index, each in enumerate(nodes) if each is None]
    if missing:
        raise ValueError(
            f"nodeRangeProperties cover no node {missing[0]}; every node from 0 to {count - 1} needs a range"
        )
    main = int(node_properties["mainNode"])
    whole = tuple(each for each in nodes if each is not None)
    variables = whole[main].environment
    try:
        minimum = int(variables.get("MUSTER_MIN_NODES", count))
    except ValueError:
        raise ValueError(
            f"MUSTER_MIN_NODES is {variables['MUSTER_MIN_NODES'][:20]!r}; expected an integer number of nodes"
        ) from None
    least = min(max(minimum, main + 1), count)  # never without the main node
    return GangSpec(main, whole, least, NativeOptions.read(variables))


def _node_spec(entry: Mapping[str, Any]) -> NodeSpec:
    container = entry.get("container") or {}
    resources = {entry["type"]: entry["value"] for entry in container.get("resourceRequirements") or []}
    environment = {entry["name"]: entry.get("value", "") for entry in container.get("environment") or []}
    ranks = environment.get("MUSTER_RANKS_PER_NODE", "1")
    if not re.fullmatch("[1-9][0-9]{0,5}", ranks):
        raise MalformedOptions(f"MUSTER_RANKS_PER_NODE is {ranks[:20]!r}, not an integer from 1 on")
    return NodeSpec(
        command=tuple(container.get("command") or ()),
        environment=environment,
        ranks=int(ranks),
        resources=Resources(
            cpus=float(resources.get("VCPU", container.get("vcpus", 1))),
            gpus=int(resources.get("GPU", 0)),
            memory=int(resources.get("MEMORY", container.get("memory", 4))),
        ),
        container=container,
        ecs=entry.get("ecs"),
    )
