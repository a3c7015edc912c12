"""Options of native jobs, read from the variables of their main node."""

from __future__ import annotations

import pytest

from orchestrator.domain.native_options import MalformedOptions, NativeOptions
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate


def test_a_node_without_variables_of_muster_has_what_aws_does() -> None:
    options = NativeOptions.read({"RUN": "mine", "LOG_LIMIT": "no number", "WORLDS": "3"})
    assert options == NativeOptions(on_child_failure="ignore", stall_timeout=None, log_limit=1 << 30)
    assert not options.is_native


def test_settings_of_the_job_yaml_reach_the_training() -> None:
    values = {"on_child_failure": "fail", "preemptible": True, "logs": {"limit": "2MiB"}, "stall_timeout": "45s"}
    document = {"name": "ant", "train": {"task": "Ant", "worlds": 16, "iterations": 3}}
    definition = compile_definition(validate({**document, **values}, "s"), "/home/me")
    [entry] = definition["nodeProperties"]["nodeRangeProperties"]
    variables = {pair["name"]: pair["value"] for pair in entry["container"]["environment"]}
    assert NativeOptions.read({**variables, "MUSTER_RUN": "old", "MUSTER_WORLDS": "64"}) == NativeOptions(
        is_native=True,
        on_child_failure="fail",
        preemptible=True,
        run="old",
        directory="/home/me",
        worlds=64,
        stall_timeout=45.0,
        log_limit=2 << 20,
    )


@pytest.mark.parametrize(("name", "value"), [("MUSTER_STALL_TIMEOUT", "soon"), ("MUSTER_LOG_LIMIT", "1MiB")])
def test_a_malformed_variable_is_refused(name: str, value: str) -> None:
    with pytest.raises(MalformedOptions):
        NativeOptions.read({name: value})


@pytest.mark.parametrize("worlds", ["-1", "many", "1" * 10, ""])
def test_an_invalid_number_of_worlds_counts_as_not_given(worlds: str) -> None:
    assert NativeOptions.read({"MUSTER_WORLDS": worlds}).worlds is None
    assert NativeOptions.read({"MUSTER_WORLDS": "1" * 9}).worlds == 111_111_111
