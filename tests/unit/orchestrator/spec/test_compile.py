"""A spec compiles to AWS Batch requests."""

from __future__ import annotations

import copy
import json
from typing import Any

import botocore.session
import botocore.validate
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.domain.gang import gang_needs
from orchestrator.domain.resources import Resources
from orchestrator.spec.compile import compile_definition, with_environment
from orchestrator.spec.model import validate

TRAIN = {"task": "Cartpole", "worlds": 4, "iterations": 2, "ppo": {"clip": 0.3}}


def definition(**changes: Any) -> dict[str, Any]:
    return compile_definition(validate({"name": "ant", **changes}, "s"), "/home/me")


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


@given(st.integers(1, 12), st.integers(1, 12), st.floats(0.01, 64), st.integers(0, 8), st.integers(4, 10**6))
def test_a_gang_needs_the_resources_of_its_spec(low: int, more: int, cpus: float, gpus: int, memory: int) -> None:
    cpus = round(cpus, 2)
    resources = {"cpus": cpus, "gpus": gpus, "memory": memory}
    made = definition(command=["x"], nodes={"min": low, "max": low + more}, resources=resources)
    needs = gang_needs(made["nodeProperties"])
    assert (needs.main, needs.minimum, len(needs.nodes)) == (0, low, low + more)
    assert {node.resources for node in needs.nodes} == {Resources(cpus, gpus, memory)}
