"""The output of ``--dry-run`` for a gang on Ray: the requested placement group with its pins."""

from __future__ import annotations

from orchestrator.engines.ray.bundles import in_words


def test_the_plan_shows_the_requested_placement_group() -> None:
    node = {"cpus": 1.5, "gpus": 1, "memory": 256, "host": "ray/n1", "pin": "abc"}
    new = {"cpus": 1.0, "gpus": 0, "memory": 64, "host": "ray/+1", "pin": None}
    assert in_words({"main": 0, "nodes": [node, new]}) == (
        "# an actor on each bundle starts the node's supervisor\n"
        "ray.util.placement_group(\n"
        "  [\n"
        '    {"CPU": 1.5, "memory": 268435456, "GPU": 1},  # node 0, the main node, on ray/n1\n'
        '    {"CPU": 1.0, "memory": 67108864},  # node 1, on ray/+1, a machine that the autoscaler is asked for\n'
        "  ],\n"
        '  strategy="STRICT_SPREAD",\n'
        "  bundle_label_selector=[\n"
        '    {"ray.io/node-id": "abc"},\n'
        "    {},\n"
        "  ],\n"
        ")"
    )
