"""Job definitions and what a submission may ask of them (reference §8.1, §8.2), through the real boto3 and ``aws``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.conftest import Serving
from tests.support.conformance.aws import PREFIX, Batch, aws, container, pairs, refused


def node_range(target: str, **changes: Any) -> dict[str, Any]:
    return {"targetNodes": target, "container": container("true", changes)}


def properties(nodes: int, *ranges: dict[str, Any], main: int = 0) -> dict[str, Any]:
    return {"numNodes": nodes, "mainNode": main, "nodeRangeProperties": list(ranges)}


# -- revisions --------------------------------------------------------------------------------------------------------


def test_every_registration_is_a_revision_and_the_latest_active_one_counts(batch: Batch, parked: str) -> None:
    request = {"jobDefinitionName": "def-revised", "type": "multinode"}
    first = batch.api.register_job_definition(**request, nodeProperties=properties(2, node_range("0:1")))
    second = batch.multinode("def-revised", "true")
    assert first["jobDefinitionName"] == "def-revised" and first["revision"] == 1
    assert first["jobDefinitionArn"] == f"{PREFIX}job-definition/def-revised:1"
    assert second == f"{PREFIX}job-definition/def-revised:2"

    def used(reference: str) -> str:
        return str(batch.describe(batch.submit(reference, "def-revised", parked))["jobDefinition"])

    bare = f"{PREFIX}job-definition/def-revised"
    found = [used(each) for each in ("def-revised", bare, "def-revised:1", f"{bare}:1")]
    assert found == [f"{bare}:{revision}" for revision in (2, 2, 1, 1)]
    batch.api.deregister_job_definition(jobDefinition="def-revised:2")
    assert used("def-revised") == f"{bare}:1"
    for gone in ("def-revised:2", f"{bare}:2"):
        with refused("does not exist or is not active"):
            batch.submit(gone, "def-revised", parked)
    batch.api.deregister_job_definition(jobDefinition=f"{bare}:1")
    with refused("does not exist or is not active"):
        batch.submit("def-revised", "def-revised", parked)
    # a number is never given out twice
    assert batch.multinode("def-revised", "true") == f"{bare}:3"
    assert used("def-revised") == f"{bare}:3"


def test_describing_shows_states_and_every_revision_by_name_number_or_arn(batch: Batch) -> None:
    arns = [batch.multinode("def-shown", "true", 1) for _ in range(4)]
    batch.api.deregister_job_definition(jobDefinition="def-shown:3")
    batch.api.deregister_job_definition(jobDefinition="def-shown:99")  # no error on AWS either

    def revisions(**query: Any) -> list[tuple[int, str]]:
        found = batch.api.describe_job_definitions(**query)["jobDefinitions"]
        return [(each["revision"], each["status"]) for each in found]

    assert revisions(jobDefinitionName="def-shown") == [(4, "ACTIVE"), (3, "INACTIVE"), (2, "ACTIVE"), (1, "ACTIVE")]
    # Metaflow and redun look their definition up like this before they register another one
    assert [number for number, _ in revisions(jobDefinitionName="def-shown", status="ACTIVE")] == [4, 2, 1]
    assert revisions(jobDefinitions=["def-shown:3", arns[0]]) == [(3, "INACTIVE"), (1, "ACTIVE")]
    assert revisions(jobDefinitionName="def-unknown") == revisions(jobDefinitions=["def-unknown:1"]) == []
    found = batch.api.get_paginator("describe_job_definitions")
    pages = found.paginate(jobDefinitionName="def-shown", PaginationConfig={"PageSize": 3})
    assert [[each["revision"] for each in page["jobDefinitions"]] for page in pages] == [[4, 3, 2], [1]]
    with refused("at most 100"):
        batch.api.describe_job_definitions(jobDefinitions=["def-shown:1"] * 101)
    with refused("NAME:N"):
        batch.api.deregister_job_definition(jobDefinition="def-shown")


def test_a_definition_comes_back_as_it_was_registered(batch: Batch) -> None:
    requested: dict[str, Any] = {
        "type": "multinode",
        "parameters": {"task": "Ant"},
        "schedulingPriority": 7,
        "nodeProperties": properties(
            4,
            node_range("0:", env={"ROLE": "any"}, container={"ulimits": [], "user": "nobody", "privileged": False}),
            node_range(
                "1:2",
                env={"ROLE": "inner"},
                container={
                    "linuxParameters": {"sharedMemorySize": 64, "initProcessEnabled": True},
                    "volumes": [{"name": "efs", "efsVolumeConfiguration": {"fileSystemId": "fs-1"}}],
                    "mountPoints": [{"sourceVolume": "efs", "containerPath": "/efs", "readOnly": True}],
                },
            ),
            main=3,
        ),
        "retryStrategy": {"attempts": 2, "evaluateOnExit": [{"onExitCode": "1*", "action": "RETRY"}]},
        "timeout": {"attemptDurationSeconds": 60},
        "tags": {"team": "robots"},
        "propagateTags": True,
    }
    answer = batch.api.register_job_definition(jobDefinitionName="def-whole", **requested)
    [found] = batch.api.describe_job_definitions(jobDefinitions=[answer["jobDefinitionArn"]])["jobDefinitions"]
    ranges = found["nodeProperties"]["nodeRangeProperties"]
    lists = ("command", "environment", "mountPoints", "resourceRequirements", "secrets", "ulimits", "volumes")
    empty: dict[str, list[Any]] = {key: [] for key in lists}
    for supplied in requested["nodeProperties"][
        "nodeRangeProperties"
    ]:  # what AWS adds: an empty list for what was left out
        supplied["container"] = {**empty, **supplied["container"]}
    assert len(ranges) == 2 and {key: found[key] for key in requested} == requested
    assert (found["jobDefinitionArn"], found["revision"], found["status"]) == (answer["jobDefinitionArn"], 1, "ACTIVE")
    assert found["containerOrchestrationType"] == "ECS"


def test_the_inner_of_nested_ranges_is_what_a_node_runs(batch: Batch, parked: str) -> None:
    ranges = [node_range("0:", env={"ROLE": "outer"}), node_range("1:2", env={"ROLE": "inner"})]
    job = batch.submit(batch.multinode("def-nested", "", 4, ranges=ranges), queue=parked)
    roles = [batch.describe(f"{job}#{node}")["container"]["environment"][0]["value"] for node in range(4)]
    assert roles == ["outer", "inner", "inner", "outer"]


def exits(**condition: str) -> dict[str, Any]:
    return {"retryStrategy": {"attempts": 2, "evaluateOnExit": [{"action": "EXIT", **condition}]}}


def of_one(**container: Any) -> dict[str, Any]:
    return {"nodeProperties": properties(1, node_range("0", container=container))}


# -- refusals ---------------------------------------------------------------------------------------------------------

RETRIES = [{"onExitCode": str(code), "action": "RETRY"} for code in range(6)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodeProperties": properties(2, node_range("0:"), main=2)}, "mainNode is 2; it must be less than numNodes"),
        ({"nodeProperties": properties(2, node_range("0:"), main=-1)}, "mainNode is -1"),
        ({"nodeProperties": properties(3, node_range("0:1"))}, "cover no node 2"),
        ({"nodeProperties": properties(3, node_range("1:"))}, "cover no node 0"),
        ({"nodeProperties": properties(6, *(node_range(str(i)) for i in range(6)))}, "6 node ranges"),
        ({"nodeProperties": properties(2, node_range("0:2"))}, "targetNodes 0:2: the nodes are 0 to 1"),
        ({"nodeProperties": properties(2, node_range("0-1"))}, "expected n, a:b, a: or :b"),
        ({"nodeProperties": properties(2)}, "0 node ranges"),
        ({"nodeProperties": properties(1001, node_range("0:"))}, "1 to 1000"),
        ({"nodeProperties": properties(0, node_range("0:"))}, "numNodes is 0"),
        ({"timeout": {"attemptDurationSeconds": 59}}, "must be at least 60"),
        ({"retryStrategy": {"attempts": 0}}, "must be 1 to 10"),
        ({"retryStrategy": {"attempts": 11}}, "must be 1 to 10"),
        ({"retryStrategy": {"attempts": 2, "evaluateOnExit": RETRIES}}, "6 entries; at most 5"),
        ({"retryStrategy": {"evaluateOnExit": RETRIES[:1]}}, "needs attempts"),
        (exits(onReason="a*b"), "* at the end only"),
        (exits(onExitCode="one"), "onExitCode 'one'"),
        (exits(onExitCode="1", action="STOP"), "RETRY or EXIT"),
        ({"schedulingPriority": 10000}, "must be 0 to 9999"),
        ({"nodeProperties": properties(1, node_range("0", env={"AWS_BATCH_X": "1"}))}, "AWS_BATCH are reserved"),
        ({"nodeProperties": properties(1, node_range("0", cpus="0"))}, "VCPU is '0'"),
        (of_one(resourceRequirements=[{"type": "MEMORY", "value": "3"}]), "MEMORY is '3'"),
        (of_one(resourceRequirements=[{"type": "VCPU", "value": "1"}] * 2), "VCPU twice"),
        (of_one(mountPoints=[{"sourceVolume": "x", "containerPath": "/x"}]), "volume 'x'"),
        ({"containerProperties": container("true", {})}, "type multinode needs nodeProperties, and only that"),
        ({"type": "container"}, "type container needs containerProperties or ecsProperties, and only that"),
        ({"tags": {f"key-{i}": "" for i in range(51)}}, "at most 50"),
        ({"jobDefinitionName": "x" * 129}, "128"),
        ({"jobDefinitionName": "a b"}, "jobDefinitionName 'a b'"),
    ],
)
def test_bad_definitions_are_refused(batch: Batch, change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"nodeProperties": properties(2, node_range("0:"))}
    request = {"jobDefinitionName": "def-bad", "type": "multinode", **good, **change}
    with refused(message):
        batch.api.register_job_definition(**request)
    assert not batch.api.describe_job_definitions(jobDefinitionName="def-bad")["jobDefinitions"]


FAIR_ALONE = "Job with shareIdentifier or schedulingPriority can onlybe submitted to job queue with fair share scheduling policy."
MATCH = "NodeOverride targets should match job definition. "
UNKNOWN = "Unable to substitute value. No parameter found for reference"


def node_override(target: str, **overrides: Any) -> dict[str, Any]:
    return {"nodePropertyOverrides": [{"targetNodes": target, "containerOverrides": overrides}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodeOverrides": node_override("0:0")}, f"{MATCH}Non matching targets - 0:0"),
        ({"nodeOverrides": {"numNodes": 3}}, "open end"),
        ({"jobDefinition": "def-open", "nodeOverrides": {"numNodes": 1}}, "mainNode is 1"),
        ({"jobDefinition": "def-open", "nodeOverrides": {"numNodes": 1001}}, "1 to 1000"),
        ({"jobDefinition": "def-high", "nodeOverrides": {"numNodes": 2}}, "begins behind the last node"),
        ({"nodeOverrides": node_override("0:1", environment=pairs({"AWS_BATCH_JOB_ID": "1"}))}, "are reserved"),
        ({"nodeOverrides": node_override("0:1", environment=pairs({"AWS_BATCHX": "1"}))}, "are reserved"),
        ({"jobDefinition": "def-refers"}, f"{UNKNOWN} task"),
        ({"nodeOverrides": node_override("0:1", command=["Ref::no"]), "parameters": {"task": "Ant"}}, f"{UNKNOWN} no"),
        ({"shareIdentifier": "A"}, FAIR_ALONE),
        ({"schedulingPriorityOverride": 1}, FAIR_ALONE),
        ({"timeout": {"attemptDurationSeconds": 59}}, "must be at least 60"),
        ({"retryStrategy": {"attempts": 0}}, "must be 1 to 10"),
        ({"retryStrategy": {"attempts": 11}}, "must be 1 to 10"),
        ({"retryStrategy": {"attempts": 1, "evaluateOnExit": RETRIES}}, "6 entries; at most 5"),
        ({"containerOverrides": {"command": ["true"]}}, "use nodeOverrides"),
        ({"arrayProperties": {"size": 2}}, "not for a multi-node parallel job"),
        ({"dependsOn": [{"jobId": "no-such-job"}]}, "does not exist"),
        ({"dependsOn": [{"type": "SEQUENTIAL"}]}, "is for array jobs"),
        ({"dependsOn": [{"jobId": "x"}] * 21}, "21 entries; at most 20"),
        ({"jobName": "_x"}, "jobName '_x'"),
        ({"jobName": "x" * 129}, "jobName"),
        ({"jobQueue": "def-unknown"}, "Job queue def-unknown does not exist"),
        ({"jobDefinition": "def-unknown"}, "Job definition def-unknown does not exist"),
        ({"tags": {"aws:mine": "1"}}, "aws:"),
    ],
)
def test_bad_submissions_are_refused(batch: Batch, parked: str, change: dict[str, Any], message: str) -> None:
    if not batch.api.describe_job_definitions(jobDefinitionName="def-refers")["jobDefinitions"]:
        batch.multinode("def-closed", "true", target="0:1")
        batch.multinode("def-open", "true", main=1)
        batch.multinode("def-high", "", 4, ranges=[node_range("0:2"), node_range("2:")])
        batch.multinode("def-refers", "true", container={"command": ["echo", "Ref::task"]})
    before = listed(batch, parked)
    with refused(message):
        batch.api.submit_job(**{"jobName": "def-refused", "jobQueue": parked, "jobDefinition": "def-closed", **change})
    assert listed(batch, parked) == before, "what was refused is nowhere"


def listed(batch: Batch, queue: str) -> list[str]:
    pages = batch.api.get_paginator("list_jobs").paginate(jobQueue=queue, jobStatus="RUNNABLE")
    return [each["jobId"] for page in pages for each in page["jobSummaryList"]]


def test_violations_of_the_aws_model_are_refused_in_the_words_of_aws(shared_server: Serving) -> None:
    """boto3 would not even send these."""
    for operation, body, parameter in [
        ("registerjobdefinition", {"type": "multinode"}, "jobDefinitionName"),
        ("registerjobdefinition", {"jobDefinitionName": 3, "type": "multinode"}, "jobDefinitionName"),
        ("submitjob", {"jobName": "x", "jobQueue": "default"}, "jobDefinition"),
        ("describejobs", {"jobs": "x"}, "jobs"),
    ]:
        answer = httpx.post(f"{shared_server.url}/v1/{operation}", json=body)
        assert answer.status_code == 400 and answer.headers["x-amzn-errortype"] == "ClientException"
        assert answer.json()["__type"] == "ClientException"
        message = answer.json()["message"]
        assert message.startswith("Error executing request, Exception : ") and parameter in message


def test_overrides_are_what_the_job_shows_and_the_definition_stays_as_it_is(batch: Batch, parked: str) -> None:
    definition = batch.multinode("def-kept", "true", target="0:1", env={"TASK": "Cartpole", "SEED": "1"})
    override = {"command": ["sh", "-c", "exit 3"], "resourceRequirements": [{"type": "MEMORY", "value": "32"}]}
    override["environment"] = pairs({"TASK": "Ant", "MAX_ITERATIONS": "5"})
    overrides = {"nodePropertyOverrides": [{"targetNodes": "0:1", "containerOverrides": override}]}
    job = batch.submit(definition, queue=parked, nodeOverrides=overrides)
    shown = batch.describe(f"{job}#1")["container"]
    assert shown["command"] == ["sh", "-c", "exit 3"]
    assert shown["environment"] == pairs({"TASK": "Ant", "SEED": "1", "MAX_ITERATIONS": "5"})
    requested = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "32"}]
    assert shown["resourceRequirements"] == requested
    [again] = batch.api.describe_job_definitions(jobDefinitions=[definition])["jobDefinitions"]
    kept = again["nodeProperties"]["nodeRangeProperties"][0]["container"]
    assert kept["environment"] == pairs({"TASK": "Cartpole", "SEED": "1"}) and kept["command"][2] == "true"


def test_the_aws_command_registers_describes_and_reads_errors(batch: Batch, parked: str, tmp_path: Path) -> None:
    url = batch.server.url
    request = {"jobDefinitionName": "def-typed", "type": "multinode"}
    request["nodeProperties"] = properties(2, node_range("0:1"))
    (tmp_path / "definition.json").write_text(json.dumps(request))
    registered = aws(url, "batch", "register-job-definition", "--cli-input-json", f"file://{tmp_path}/definition.json")
    assert registered["revision"] == 1
    shown = aws(*(url, "batch", "describe-job-definitions", "--job-definition-name", "def-typed", "--status", "ACTIVE"))
    [entry] = shown["jobDefinitions"][0]["nodeProperties"]["nodeRangeProperties"]
    supplied = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
    assert {key: entry["container"][key] for key in supplied} == supplied
    submit = ("submit-job", "--job-name", "def-typed", "--job-queue", parked, "--job-definition", "def-typed:2")
    output = aws(url, "batch", *submit, fails=True)
    assert "(ClientException) when calling the SubmitJob operation: Job definition def-typed:2 does not exist" in output
    aws(url, "batch", "deregister-job-definition", "--job-definition", registered["jobDefinitionArn"])
    [found] = batch.api.describe_job_definitions(jobDefinitionName="def-typed")["jobDefinitions"]
    assert found["status"] == "INACTIVE"
