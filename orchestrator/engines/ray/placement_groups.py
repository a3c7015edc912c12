"""The request for a gang to the driver of its job: its placement group, with a bundle for each node, each on a machine of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from orchestrator.engines.ray.folder import NEW
from shared_store.contract.node import NodeContract

STRATEGY = "STRICT_SPREAD"


@dataclass(frozen=True)
class NodeRequest:
    """One node."""

    contract: NodeContract
    command: Sequence[str]
    environment: Mapping[str, str]
    prefix: Sequence[str]
    """Goes before the command: what gives it its mounts."""
    cpus: float
    gpus: int
    memory: int
    """MiB."""
    host: str
    pin: str | None
    """Id of the Ray node that it goes to; None for any that has room."""


@dataclass(frozen=True)
class GangRequest:
    """A whole gang."""

    gang: str
    main: int
    directory: str | None
    nodes: Sequence[NodeRequest]

    def document(self) -> dict[str, Any]:
        """As the driver reads it, for JSON."""
        return asdict(self)


def bundle_of(node: Mapping[str, Any]) -> dict[str, float]:
    """The resources of a node of a request's document."""
    bundle = {"CPU": node["cpus"], "memory": node["memory"] * 2**20}
    return bundle | ({"GPU": node["gpus"]} if node["gpus"] else {})


def selector_of(node: Mapping[str, Any]) -> dict[str, str]:
    """On which machine; empty for any that has room."""
    return {"ray.io/node-id": node["pin"]} if node["pin"] else {}


def in_words(plan: Mapping[str, Any]) -> str:
    """The placement group of a request's document, as Ray gets it."""
    bundles, selectors = [], []
    for index, node in enumerate(plan["nodes"]):
        title = f"node {index}{', the main node' if index == plan['main'] else ''}"
        new = ", a machine that the autoscaler is asked for" if node["host"].startswith(NEW) else ""
        bundles.append(f"    {json.dumps(bundle_of(node))},  # {title}, on {node['host']}{new}\n")
        selectors.append(f"    {json.dumps(selector_of(node))},\n")
    return (
        "# an actor on each bundle starts the node's supervisor\nray.util.placement_group(\n"
        f'  [\n{"".join(bundles)}  ],\n  strategy="{STRATEGY}",\n  bundle_label_selector=[\n{"".join(selectors)}  ],\n)'
    )
