"""Placement groups of Ray: a gang's has a bundle for each node, each on a machine of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from orchestrator.engines.ray.folder import NEW

STRATEGY = "STRICT_SPREAD"


def bundle_of(node: Mapping[str, Any]) -> dict[str, float]:
    """The resources of a node of a plan."""
    bundle = {"CPU": node["cpus"], "memory": node["memory"] * 2**20}
    if node["gpus"]:
        bundle["GPU"] = node["gpus"]
    return bundle


def selector_of(node: Mapping[str, Any]) -> dict[str, str]:
    """On which machine; empty for any that has room."""
    return {"ray.io/node-id": node["pin"]} if node["pin"] else {}


def in_words(plan: Mapping[str, Any]) -> str:
    """The placement group of a plan, as it is asked for."""
    bundles = []
    for index, node in enumerate(plan["nodes"]):
        what = f"node {index}{', the main node' if index == plan['main'] else ''}"
        new = ", a machine that the autoscaler is asked for" if node["host"].startswith(NEW) else ""
        bundles.append(f"    {json.dumps(bundle_of(node))},  # {what}, on {node['host']}{new}")
    selectors = [f"    {json.dumps(selector_of(node))}," for node in plan["nodes"]]
    return "\n".join(
        [
            "# an actor on each bundle starts the node's supervisor",
            "ray.util.placement_group(",
            "  [",
            *bundles,
            "  ],",
            f'  strategy="{STRATEGY}",',
            "  bundle_label_selector=[",
            *selectors,
            "  ],",
            ")",
        ]
    )
