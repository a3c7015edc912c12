"""Facts of a job definition, read once."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.domain.gang import gang_needs
from orchestrator.domain.native_options import MalformedOptions


def properties(*ranks: str | None) -> dict[str, Any]:
    """One node for each of ``ranks``, which is what its definition says of them."""
    ranges = [
        {
            "targetNodes": str(index),
            "container": {"environment": [{"name": "MUSTER_RANKS_PER_NODE", "value": each}] if each else []},
        }
        for index, each in enumerate(ranks)
    ]
    return {"numNodes": len(ranks), "mainNode": 0, "nodeRangeProperties": ranges}


def test_each_node_has_its_own_number_of_ranks_and_one_where_none_is_said() -> None:
    assert [node.ranks for node in gang_needs(properties("2", None, "8")).nodes] == [2, 1, 8]


@pytest.mark.parametrize("value", ["0", "-1", "two", "1.5", " 2", "9999999"])
def test_a_number_of_ranks_that_is_none_is_refused(value: str) -> None:
    with pytest.raises(MalformedOptions, match=f"MUSTER_RANKS_PER_NODE is '{value}'"):
        gang_needs(properties("1", value))


def test_a_node_keeps_the_name_of_the_container_in_its_ecs_properties() -> None:
    given = properties(None, None)
    given["nodeRangeProperties"][1]["ecs"] = "main"
    assert [node.ecs for node in gang_needs(given).nodes] == [None, "main"]
