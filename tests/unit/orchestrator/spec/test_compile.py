"""A spec compiles to AWS Batch requests, and what a gang needs is read back from them."""

from __future__ import annotations

import copy
import json
from typing import Any

import botocore.session
import botocore.validate
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.domain.gang import gang_needs, target_nodes
from orchestrator.domain.native_options import MalformedOptions, NativeOptions
from orchestrator.domain.resources import Resources
from orchestrator.spec.compile import compile_definition, with_environment
from orchestrator.spec.model import validate

TRAIN = {"task": "Cartpole", "worlds": 4, "iterations": 2, "ppo": {"clip": 0.3}}


def definition(**changes: Any) -> dict[str, Any]:
    return compile_definition(validate({"name": "ant", **changes}, "s"), "/home/me")


def container(**changes: Any) -> dict[str, Any]:
    return {"command": ["x"], **changes}


def properties(*ranges: tuple[str, dict[str, Any]], count: int = 4, main: int = 0) -> dict[str, Any]:
    entries = [{"targetNodes": target, "container": each} for target, each in ranges]
    return {"numNodes": count, "mainNode": main, "nodeRangeProperties": entries}


# -- compiling --------------------------------------------------------------------------------------------------------


def test_a_training_spec_becomes_a_multinode_definition() -> None:
    request = definition(
        train=TRAIN, nodes=3, resources={"cpus": 2.5, "gpus": 2, "memory": "4GiB"}, timeout="2h", image="me/ant:1"
    )
    [entry] = request["nodeProperties"].pop("nodeRangeProperties")
    environment = {pair["name"]: pair["value"] for pair in entry["container"].pop("environment")}
    assert request == {
        "jobDefinitionName": "ant",
        "type": "multinode",
        "nodeProperties": {"numNodes": 3, "mainNode": 0},
        "retryStrategy": {"attempts": 3, "evaluateOnExit": [{"onExitCode": "2", "action": "EXIT"}]},
        "timeout": {"attemptDurationSeconds": 7200},
    }
    assert entry == {
        "targetNodes": "0:",
        "container": {
            "image": "me/ant:1",
            "command": ["python", "-P", "-m", "worker.train"],
            "resourceRequirements": [
                {"type": "VCPU", "value": "2.5"},
                {"type": "MEMORY", "value": "4096"},
                {"type": "GPU", "value": "2"},
            ],
        },
    }
    assert json.loads(environment.pop("MUSTER_SPEC"))["train"] == {**TRAIN, "seed": 1, "algorithm": "ppo", "config": {}}
    assert environment == {
        "MUSTER_ON_CHILD_FAILURE": "restart",
        "MUSTER_RANKS_PER_NODE": "2",
        "MUSTER_MIN_NODES": "3",
        "MUSTER_STALL_TIMEOUT": "300",
        "MUSTER_LOG_LIMIT": "1073741824",
        "MUSTER_DIRECTORY": "/home/me",
    }


@pytest.mark.parametrize(
    ("kind", "section", "command"),
    [
        ("train", TRAIN, ["python", "-P", "-m", "worker.train"]),
        ("evaluate", {"run": "ant"}, ["python", "-P", "-m", "worker.evaluate"]),
        ("export", {"run": "ant"}, ["python", "-P", "-m", "worker.export"]),
        ("command", ["python", "my_train.py"], ["python", "my_train.py"]),
    ],
)
def test_each_kind_of_job_has_its_command(kind: str, section: Any, command: list[str]) -> None:
    assert list(gang_needs(definition(**{kind: section})["nodeProperties"]).nodes[0].command) == command


def test_the_user_s_environment_is_carried_and_a_job_without_a_timeout_has_none() -> None:
    made = definition(command=["x"], environment={"A": "b c", "EMPTY": ""})
    environment = gang_needs(made["nodeProperties"]).nodes[0].environment
    assert (environment["A"], environment["EMPTY"]) == ("b c", "") and "timeout" not in made


def test_variables_are_added_on_every_node_and_the_definition_stays() -> None:
    made = definition(command=["x"], environment={"A": "b", "C": "d"})["nodeProperties"]
    before = copy.deepcopy(made)
    added = gang_needs(with_environment(made, {"MUSTER_RUN": "old", "C": "e"})).nodes[0].environment
    assert (added["A"], added["C"], added["MUSTER_RUN"]) == ("b", "e", "old") and made == before


def test_aws_s_own_model_of_the_api_accepts_the_definition() -> None:
    service = botocore.session.get_session().get_service_model("batch")
    spec = validate({"name": "ant", "train": TRAIN, "nodes": {"min": 2, "max": 4}, "timeout": "2h"}, "s")
    shape = service.operation_model("RegisterJobDefinition").input_shape
    report = botocore.validate.ParamValidator().validate(compile_definition(spec, "/home/me"), shape)
    assert not report.has_errors(), report.generate_report()


# -- reading ----------------------------------------------------------------------------------------------------------


TARGETS = {"0:": [0, 1, 2, 3], ":": [0, 1, 2, 3], ":1": [0, 1], "1:2": [1, 2], "3": [3], "2:": [2, 3], "5:": []}


def test_target_nodes_are_read_as_aws_reads_them() -> None:
    assert {text: list(target_nodes(text, 4)) for text in TARGETS} == TARGETS


@pytest.mark.parametrize("text", ["", "a", "-1", "1-2", "0:1:2", "1:b", " 1", "1.5"])
def test_target_nodes_of_another_form_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected n, a:b, a: or :b"):
        target_nodes(text, 4)


def test_of_nested_ranges_the_inner_one_counts_of_equal_ones_the_later_and_each_node_needs_one() -> None:
    outer, inner, one = ("0:", container(command=["outer"])), ("1:2", container(command=["inner"])), ("2", container())
    for ranges in ([outer, inner, one], [one, inner, outer], [inner, outer, one]):
        commands = [node.command for node in gang_needs(properties(*ranges)).nodes]
        assert commands == [("outer",), ("inner",), ("x",), ("outer",)]
    ranges = [("0:", container(command=["first"])), ("0:3", container(command=["second"]))]
    assert {node.command for node in gang_needs(properties(*ranges)).nodes} == {("second",)}
    assert len(gang_needs(properties(("0:9", container()), count=2)).nodes) == 2, "a range may exceed the nodes"
    with pytest.raises(ValueError, match="cover no node 2; every node from 0 to 3 needs a range"):
        gang_needs(properties(("0:1", container()), ("3", container())))


def test_resources_are_read_from_requirements_or_from_the_older_fields() -> None:
    newer = [{"type": kind, "value": value} for kind, value in (("VCPU", "0.5"), ("MEMORY", "2048"), ("GPU", "2"))]
    ranges = [("0", container(resourceRequirements=newer)), ("1", container(vcpus=3, memory=512)), ("2:", container())]
    needs = gang_needs(properties(*ranges))
    assert (needs.minimum, needs.options, needs.spec) == (4, NativeOptions(), None), "as on AWS"
    assert [node.resources for node in needs.nodes[:3]] == [
        Resources(0.5, 2, 2048),
        Resources(3, 0, 512),
        Resources(1, 0, 4),
    ]


def test_settings_are_those_of_the_main_node() -> None:
    def with_policy(policy: str) -> dict[str, Any]:
        return container(environment=[{"name": "MUSTER_ON_CHILD_FAILURE", "value": policy}])

    needs = gang_needs(properties(("0:", with_policy("fail")), ("2", with_policy("restart")), main=2))
    assert needs.options.on_child_failure == "restart"


@pytest.mark.parametrize(
    ("minimum", "main", "expected"), [("2", 0, 2), ("9", 0, 4), ("1", 2, 3), ("4", 3, 4), ("0", 0, 1)]
)
def test_a_gang_may_start_smaller_but_never_without_its_main_node(minimum: str, main: int, expected: int) -> None:
    smaller = container(environment=[{"name": "MUSTER_MIN_NODES", "value": minimum}])
    assert gang_needs(properties(("0:", smaller), main=main)).minimum == expected


def ranks(value: str | None) -> dict[str, Any]:
    return container(environment=[{"name": "MUSTER_RANKS_PER_NODE", "value": value}] if value else [])


def test_each_node_has_its_own_number_of_ranks_and_the_name_of_its_container_in_ecs_properties() -> None:
    given = properties(("0", ranks("2")), ("1", ranks(None)), ("2", ranks("8")), count=3)
    given["nodeRangeProperties"][1]["ecs"] = "main"
    assert [(node.ranks, node.ecs) for node in gang_needs(given).nodes] == [(2, None), (1, "main"), (8, None)]


@pytest.mark.parametrize("value", ["0", "-1", "two", "1.5", " 2", "9999999"])
def test_a_number_of_ranks_that_is_none_is_refused(value: str) -> None:
    with pytest.raises(MalformedOptions, match=f"MUSTER_RANKS_PER_NODE is '{value}'"):
        gang_needs(properties(("0", ranks("1")), ("1", ranks(value)), count=2))


@given(st.integers(1, 12), st.integers(1, 12), st.floats(0.01, 64), st.integers(0, 8), st.integers(4, 10**6))
def test_a_gang_needs_the_resources_of_its_spec(low: int, more: int, cpus: float, gpus: int, memory: int) -> None:
    cpus = round(cpus, 2)
    resources = {"cpus": cpus, "gpus": gpus, "memory": memory}
    made = definition(command=["x"], nodes={"min": low, "max": low + more}, resources=resources)
    needs = gang_needs(made["nodeProperties"])
    assert (needs.main, needs.minimum, len(needs.nodes)) == (0, low, low + more)
    assert {node.resources for node in needs.nodes} == {Resources(cpus, gpus, memory)}
