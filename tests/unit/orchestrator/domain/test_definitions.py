"""What a job definition of AWS says about a gang."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.domain.gang import GangSpec, Shape, gang_needs, target_nodes
from orchestrator.domain.native_options import MalformedOptions
from orchestrator.domain.resources import Resources


def definition(*ranges: tuple[str, dict[str, Any]], nodes: int = 4, main: int = 0) -> dict[str, Any]:
    entries = [{"targetNodes": targets, "container": container} for targets, container in ranges]
    return {"numNodes": nodes, "mainNode": main, "nodeRangeProperties": entries}


def variables(**values: str) -> dict[str, Any]:
    return {"environment": [{"name": name, "value": value} for name, value in values.items()]}


def commands(spec: GangSpec) -> list[str]:
    return [" ".join(node.command) for node in spec.nodes]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:", [0, 1, 2, 3]),
        (":", [0, 1, 2, 3]),
        ("2:", [2, 3]),
        (":1", [0, 1]),
        ("1:2", [1, 2]),
        ("3", [3]),
        ("0", [0]),
    ],
)
def test_target_nodes_are_a_range_with_both_ends(text: str, expected: list[int]) -> None:
    assert list(target_nodes(text, 4)) == expected


@pytest.mark.parametrize("text", ["", "a", "-1", "1:2:3", "1234567", "0:1234567", " 1"])
def test_malformed_target_nodes_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected n, a:b, a: or :b"):
        target_nodes(text, 4)


def test_of_nested_ranges_the_inner_one_counts_in_any_order_and_of_equal_ones_the_later() -> None:
    outer, inner = ("0:", {"command": ["outer"]}), ("1:2", {"command": ["inner"]})
    for ranges in (outer, inner), (inner, outer):
        assert commands(gang_needs(definition(*ranges))) == ["outer", "inner", "inner", "outer"]
    assert commands(gang_needs(definition(outer, ("0:", {"command": ["later"]})))) == ["later"] * 4
    assert commands(gang_needs(definition(("0:9", {"command": ["x"]}), nodes=2))) == ["x", "x"], "beyond the last node"


def test_every_node_needs_a_range() -> None:
    with pytest.raises(ValueError, match="no node 2; every node from 0 to 3 needs a range"):
        gang_needs(definition((":1", {}), ("3", {})))
    with pytest.raises(ValueError, match="nodeProperties are empty"):
        gang_needs({})


def test_a_node_has_what_its_container_asks_for_and_else_what_aws_takes() -> None:
    kinds = {"VCPU": "2.5", "GPU": "3", "MEMORY": "512"}
    required = {"resourceRequirements": [{"type": kind, "value": value} for kind, value in kinds.items()]}
    older = {"vcpus": 3, "memory": 700}
    requested = definition(
        ("0", required), ("1", older), ("2", {"resourceRequirements": None, "environment": None}), ("3", {})
    )
    requested["nodeRangeProperties"][3] = {"targetNodes": "3", "ecs": "main"}
    spec = gang_needs(requested)
    assert [node.resources for node in spec.nodes] == [
        Resources(2.5, 3, 512),
        Resources(3, 0, 700),
        Resources(1, 0, 4),
        Resources(1, 0, 4),
    ]
    assert [(node.ecs, node.ranks, node.command) for node in spec.nodes] == [
        (None, 1, ()),
        (None, 1, ()),
        (None, 1, ()),
        ("main", 1, ()),
    ]
    assert spec.nodes[1].container == older


def test_a_gang_of_aws_starts_whole_and_a_native_one_with_as_few_nodes_as_it_says_but_never_without_its_main_node() -> (
    None
):
    for main, least, expected in ((0, None, 4), (0, "2", 2), (2, "1", 3), (2, "2", 3), (0, "9", 4), (0, "0", 1)):
        environment = {} if least is None else {"MUSTER_MIN_NODES": least}
        spec = gang_needs(definition(("0:", variables(**environment)), main=main))
        assert (spec.minimum, spec.main, spec.shape.minimum) == (expected, main, expected)


def test_options_and_spec_are_those_of_the_main_node() -> None:
    native = variables(MUSTER_ON_CHILD_FAILURE="fail", MUSTER_SPEC='{"name": "ant"}')
    native["environment"].append({"name": "EMPTY"})
    spec = gang_needs(definition((":0", {}), ("1:", native), main=1))
    assert spec.options.is_native and spec.spec == {"name": "ant"} and spec.nodes[0].spec is None
    assert spec.nodes[1].environment["EMPTY"] == ""
    assert gang_needs(definition(("0:", {}))).spec is None
    with pytest.raises(ValueError, match="MUSTER_SPEC is not an object"):
        _ = gang_needs(definition(("0:", variables(MUSTER_SPEC="[]")))).spec


@pytest.mark.parametrize("ranks", ["0", "-1", "two", "1.5", " 2", "9999999", "10"])
def test_ranks_are_a_whole_number_from_1_on(ranks: str) -> None:
    requested = definition(("0:", variables(MUSTER_RANKS_PER_NODE=ranks)))
    if ranks == "10":
        assert gang_needs(requested).nodes[3].ranks == 10
    else:
        with pytest.raises(MalformedOptions, match=f"MUSTER_RANKS_PER_NODE is '{ranks}'"):
            gang_needs(requested)


def test_a_shape_groups_equal_nodes_the_most_demanding_first_and_sums_them() -> None:
    small, gpu, wide, large = Resources(1, 0, 10), Resources(1, 1, 10), Resources(2, 0, 10), Resources(2, 0, 20)
    shape = Shape((small, gpu, wide, small, large), 2, 0)
    assert shape.groups == ((gpu, (1,)), (large, (4,)), (wide, (2,)), (small, (0, 3)))
    assert (shape.uses_gpus, shape.demand, shape.least) == (True, 1.0, Resources(2, 1, 20))
    on_cpus = Shape((small, wide), 2, 0)
    assert (on_cpus.uses_gpus, on_cpus.demand) == (False, 3.0)
    assert hash(on_cpus) == hash(Shape((small, wide), 2, 0)) != hash(Shape((small, wide), 1, 0))
