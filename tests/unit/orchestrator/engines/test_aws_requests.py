"""The requests that a gang becomes at AWS: what is left to its image, and what is not passed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from orchestrator.engines.api import EngineError, node_plans
from orchestrator.engines.aws_batch.config import AwsConfig
from orchestrator.engines.aws_batch.requests import requests_for
from orchestrator.engines.testing.rigs import make_gang

CONFIG = AwsConfig(job_queue="q", image="registry/muster:1", file_system="fs-1", region="us-east-1")


def container_of(image: str, command: Sequence[str], **members: Any) -> dict[str, Any]:
    gang = replace(make_gang("job", "/store", 1, "aws-batch", command, [{"image": image, **members}]), is_native=False)
    requests = requests_for(gang, node_plans(gang, ["10.0.0.1"], 29500), CONFIG)
    [entry] = requests.definition["nodeProperties"]["nodeRangeProperties"]
    return dict(entry["container"])


def test_a_node_without_a_command_leaves_it_to_its_image() -> None:
    assert "command" not in container_of("any:1", [])
    assert container_of("any:1", ["true"])["command"] == ["true"]


def test_an_image_with_muster_can_t_be_looked_up_for_its_command() -> None:
    with pytest.raises(
        EngineError, match="node 0 has no command, and that of image registry/muster:2 can't be looked up"
    ):
        container_of("registry/muster:2", [])


def test_members_of_fargate_are_not_passed_on_to_ec2() -> None:
    fargate = {
        "networkConfiguration": {"assignPublicIp": "ENABLED"},
        "fargatePlatformConfiguration": {"platformVersion": "LATEST"},
        "ephemeralStorage": {"sizeInGiB": 30},
        "runtimePlatform": {"cpuArchitecture": "X86_64"},
        "platformVersion": "LATEST",
    }
    passed = container_of("any:1", ["true"], executionRoleArn="arn:x", **fargate)
    assert not set(fargate) & set(passed) and passed["executionRoleArn"] == "arn:x"
