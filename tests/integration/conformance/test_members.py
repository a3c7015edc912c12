"""Every member that AWS's model has of a definition and a submission works, is refused, or is documented to have no effect."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import botocore.session
import pytest

from tests.conftest import REPOSITORY
from tests.support.conformance.aws import Batch, refused
from tests.support.definitions import container

CONTAINER = container(cpus="1")
LOG = {"logDriver": "awslogs"}
CONSUMABLE = {"consumableResourceList": [{"consumableResource": "licence", "quantity": 1}]}
SECRET = [{"name": "A", "valueFrom": "b"}]
LIMITED = "consumableResourceProperties"
EKS = {"podProperties": {"containers": [{"image": "any"}]}}
S3 = {"volumes": [{"name": "v", "s3filesVolumeConfiguration": {"fileSystemArn": "any"}}]}

SAME = {
    "nodeProperties.nodeRangeProperties.container": "container",
    "containerProperties": "container",
    "nodeProperties.nodeRangeProperties.ecsProperties.taskProperties": "task",
    "ecsProperties.taskProperties": "task",
    "nodeOverrides.nodePropertyOverrides.containerOverrides": "containerOverrides",
    "nodeOverrides.nodePropertyOverrides.ecsPropertiesOverride": "ecsPropertiesOverride",
}
"""Members that are the same in several places; the name that they have below."""

WORKS = {
    *("jobDefinitionName", "type", "parameters", "schedulingPriority", "retryStrategy", "timeout", "tags"),
    *("nodeProperties.numNodes", "nodeProperties.mainNode", "nodeProperties.nodeRangeProperties.targetNodes"),
    *(f"container.{name}" for name in ("image", "vcpus", "memory", "command", "environment", "mountPoints", "user")),
    *("container.resourceRequirements", "container.volumes.name", "container.volumes.host", "container.secrets"),
    "container.volumes.efsVolumeConfiguration.rootDirectory",
    *(f"task.containers.{name}" for name in ("command", "environment", "essential", "image", "mountPoints", "name")),
    *(f"task.containers.{name}" for name in ("resourceRequirements", "secrets", "user")),
    *("task.volumes.name", "task.volumes.host", "task.volumes.efsVolumeConfiguration.rootDirectory"),
    *("jobName", "jobQueue", "shareIdentifier", "schedulingPriorityOverride", "arrayProperties", "dependsOn"),
    *("jobDefinition", "nodeOverrides.numNodes", "nodeOverrides.nodePropertyOverrides.targetNodes"),
    *(f"containerOverrides.{name}" for name in ("vcpus", "memory", "command", "environment", "resourceRequirements")),
    "ecsPropertiesOverride",
}
"""Tests elsewhere show that they do."""

WITHOUT_EFFECT = {
    *("propagateTags", "platformCapabilities", "nodeProperties.nodeRangeProperties.instanceTypes"),
    *(f"container.{name}" for name in ("networkConfiguration", "fargatePlatformConfiguration")),
    *(f"task.{name}" for name in ("networkConfiguration", "platformVersion")),
    *(f"{place}.{name}" for place in ("container", "task") for name in ("ephemeralStorage", "runtimePlatform")),
    *("containerOverrides.instanceType", "nodeOverrides.nodePropertyOverrides.instanceTypes"),
    *(f"container.{name}" for name in ("jobRoleArn", "executionRoleArn", "instanceType", "logConfiguration.options")),
    *(f"container.{name}" for name in ("readonlyRootFilesystem", "privileged", "ulimits", "linuxParameters")),
    *("task.executionRoleArn", "task.taskRoleArn", "task.containers.logConfiguration.options"),
    *(f"task.containers.{name}" for name in ("readonlyRootFilesystem", "privileged", "ulimits", "linuxParameters")),
    *(
        f"{place}.volumes.efsVolumeConfiguration.{name}"
        for place in ("container", "task")
        for name in ("fileSystemId", "transitEncryption", "transitEncryptionPort", "authorizationConfig")
    ),
}
"""On every engine, or on those whose nodes are processes: docs/aws-differences.md has each of them."""

REFUSED: dict[str, dict[str, Any]] = {
    "container.enableExecuteCommand": {"container": {"enableExecuteCommand": True}},
    "container.repositoryCredentials": {"container": {"repositoryCredentials": {"credentialsParameter": "any"}}},
    "container.logConfiguration.logDriver": {"container": {"logConfiguration": {"logDriver": "syslog"}}},
    "container.logConfiguration.secretOptions": {"container": {"logConfiguration": {**LOG, "secretOptions": SECRET}}},
    "container.volumes.s3filesVolumeConfiguration": {"container": S3},
    "task.containers.dependsOn": {"only": {"dependsOn": [{"containerName": "b", "condition": "START"}]}},
    "task.containers.firelensConfiguration": {"only": {"firelensConfiguration": {"type": "fluentd"}}},
    "task.containers.startTimeout": {"only": {"startTimeout": 2}},
    "task.containers.stopTimeout": {"only": {"stopTimeout": 2}},
    "task.containers.repositoryCredentials": {"only": {"repositoryCredentials": {"credentialsParameter": "any"}}},
    "task.containers.logConfiguration.logDriver": {"only": {"logConfiguration": {"logDriver": "splunk"}}},
    "task.containers.logConfiguration.secretOptions": {"only": {"logConfiguration": {**LOG, "secretOptions": SECRET}}},
    "task.volumes.s3filesVolumeConfiguration": {"task": S3},
    "task.ipcMode": {"task": {"ipcMode": "host"}},
    "task.pidMode": {"task": {"pidMode": "host"}},
    "task.networkMode": {"task": {"networkMode": "host"}},
    "task.enableExecuteCommand": {"task": {"enableExecuteCommand": True}},
    "eksProperties": {"definition": {"eksProperties": EKS}},
    LIMITED: {"definition": {LIMITED: CONSUMABLE}},
    "nodeProperties.nodeRangeProperties.eksProperties": {"range": {"eksProperties": EKS}},
    f"nodeProperties.nodeRangeProperties.{LIMITED}": {"range": {LIMITED: CONSUMABLE}},
    "eksPropertiesOverride": {"job": {"eksPropertiesOverride": EKS}},
    f"{LIMITED}Override": {"job": {f"{LIMITED}Override": CONSUMABLE}},
    "nodeOverrides.nodePropertyOverrides.eksPropertiesOverride": {"override": {"eksPropertiesOverride": EKS}},
    f"nodeOverrides.nodePropertyOverrides.{LIMITED}Override": {"override": {f"{LIMITED}Override": CONSUMABLE}},
}
"""A request for each: what it adds to a definition or a submission that is fine."""


def members(shape: Any, above: str = "") -> Iterator[str]:
    """The paths of all leaves, those that are the same under one name."""
    for name, member in shape.members.items():
        path = f"{above}.{name}".lstrip(".")
        path = SAME.get(path, path)
        while member.type_name == "list":
            member = member.member
        below = member.type_name == "structure" and not name.startswith("eks")
        yield from members(member, path) if below else [path]


def test_every_member_of_the_model_has_its_fate() -> None:
    model = botocore.session.Session().get_service_model("batch")
    fates = [*WORKS, *WITHOUT_EFFECT, *REFUSED]
    shapes = [model.operation_model(operation).input_shape for operation in ("RegisterJobDefinition", "SubmitJob")]
    found = {path for shape in shapes for path in members(shape)}

    def fates_of(path: str) -> list[str]:
        return [fate for fate in fates if path == fate or path.startswith(f"{fate}.")]

    assert {path: fates_of(path) for path in found if len(fates_of(path)) != 1} == {}
    assert {fate for fate in fates if not any(fate in fates_of(path) for path in found)} == set(), "not in the model"


def test_members_without_effect_stand_in_the_documentation() -> None:
    text = (REPOSITORY / "docs" / "aws-differences.md").read_text()
    differs = text.partition("## Members that are kept and have no effect")[2].partition("\n## ")[0]
    assert {path for path in WITHOUT_EFFECT if f"`{path.rpartition('.')[2]}`" not in differs} == set()


@pytest.mark.parametrize("member", REFUSED)
def test_unsupported_members_are_refused_by_name(batch: Batch, member: str) -> None:
    change = REFUSED[member]
    name = member.rpartition(".")[2]
    if "range" in change or "override" in change:
        entry = {"targetNodes": "0:", "container": CONTAINER, **change.get("range", {})}
        kind, properties = "multinode", {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": [entry]}
        definition: dict[str, Any] = {"nodeProperties": properties}
    elif "task" in change or "only" in change:
        containers = [{**CONTAINER, "name": "main", **change.get("only", {})}]
        kind = "container"
        definition = {"ecsProperties": {"taskProperties": [{"containers": containers, **change.get("task", {})}]}}
    else:
        kind, definition = "container", {"containerProperties": {**CONTAINER, **change.get("container", {})}}
    definition |= change.get("definition", {})
    if "job" not in change and "override" not in change:
        with refused(name):
            batch.register("member", kind, **definition)
        return
    arn = batch.register("member", kind, **definition)
    overrides = [{"targetNodes": "0:", **change.get("override", {})}]
    job = change.get("job") or {"nodeOverrides": {"nodePropertyOverrides": overrides}}
    with refused(name):
        batch.submit(arn, **job)
