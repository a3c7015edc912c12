"""The five operations through the real boto3, on a real server with the real local engine."""

from __future__ import annotations

import itertools
from typing import Any

import boto3
import httpx
import pytest
from botocore.config import Config
from botocore.exceptions import ClientError

from tests.conftest import Serving


@pytest.fixture(scope="module")
def batch(shared_server: Serving) -> Any:
    return boto3.client(
        "batch",
        endpoint_url=shared_server.url,
        region_name="us-east-1",
        aws_access_key_id="any",
        aws_secret_access_key="any",
        config=Config(retries={"max_attempts": 0}),
    )


def definition(name: str, nodes: int = 2, command: list[str] | None = None, **changes: Any) -> dict[str, Any]:
    container = {
        "image": "any",
        "command": command or ["true"],
        "resourceRequirements": [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}],
        "environment": [{"name": "GREETING", "value": "hello"}],
    }
    properties = {
        "numNodes": nodes,
        "mainNode": 0,
        "nodeRangeProperties": [{"targetNodes": "0:", "container": {**container, **changes.pop("container", {})}}],
        **changes.pop("properties", {}),
    }
    return {"jobDefinitionName": name, "type": "multinode", "nodeProperties": properties, **changes}


def test_a_second_registration_is_revision_two_and_a_bare_name_uses_it(batch: Any) -> None:
    first = batch.register_job_definition(**definition("revisions"))
    second = batch.register_job_definition(**definition("revisions"))
    assert (first["revision"], second["revision"]) == (1, 2)
    assert second["jobDefinitionArn"].endswith("job-definition/revisions:2")
    job = batch.submit_job(jobName="by-name", jobQueue="default", jobDefinition="revisions")
    assert batch.describe_jobs(jobs=[job["jobId"]])["jobs"][0]["jobDefinition"] == second["jobDefinitionArn"]


def test_a_gang_runs_and_is_described_in_awss_shapes(batch: Any, shared_server: Serving) -> None:
    batch.register_job_definition(
        **definition("shapes", command=["sh", "-c", "echo $GREETING $AWS_BATCH_JOB_NODE_INDEX; sleep 1"])
    )
    submitted = batch.submit_job(jobName="shapes", jobQueue="default", jobDefinition="shapes:1")
    assert submitted["jobArn"].endswith(f"job/{submitted['jobId']}")
    shared_server.wait(submitted["jobId"])
    parent, child, by_arn = batch.describe_jobs(
        jobs=[submitted["jobId"], f"{submitted['jobId']}#1", f"{submitted['jobArn']}#0", "no-such-job"]
    )["jobs"]
    assert parent["status"] == "SUCCEEDED" and "container" not in parent
    assert parent["nodeProperties"]["numNodes"] == 2
    assert parent["createdAt"] <= parent["startedAt"] <= parent["stoppedAt"]
    assert parent["attempts"][0]["container"]["exitCode"] == 0
    assert parent["attempts"][0]["container"]["logStreamName"]
    assert child["nodeDetails"] == {"nodeIndex": 1, "isMainNode": False}
    assert child["jobId"].endswith("#1") and child["container"]["image"] == "any"
    assert by_arn["nodeDetails"]["isMainNode"] is True
    assert sorted(shared_server.log(submitted["jobId"], rank=0) + shared_server.log(submitted["jobId"], rank=1)) == [
        "hello 0",
        "hello 1",
    ]


def test_overrides_merge_environment_by_name_and_replace_the_command(batch: Any, shared_server: Serving) -> None:
    batch.register_job_definition(**definition("overridden", nodes=1))
    override = {
        "command": ["sh", "-c", "echo $GREETING $WHOM"],
        "environment": [{"name": "WHOM", "value": "world"}],
    }
    job = batch.submit_job(
        jobName="overridden",
        jobQueue="default",
        jobDefinition="overridden",
        nodeOverrides={"nodePropertyOverrides": [{"targetNodes": "0:", "containerOverrides": override}]},
    )
    shared_server.wait(job["jobId"])
    assert "hello world" in shared_server.log(job["jobId"])


def test_listing_shows_running_jobs_unless_a_filter_asks_for_all(batch: Any, shared_server: Serving) -> None:
    batch.register_job_definition(**definition("listed", nodes=2))
    job = batch.submit_job(jobName="Listed-One", jobQueue="default", jobDefinition="listed")["jobId"]
    shared_server.wait(job)
    assert job not in [each["jobId"] for each in batch.list_jobs(jobQueue="default")["jobSummaryList"]]
    by_name = batch.list_jobs(jobQueue="default", filters=[{"name": "JOB_NAME", "values": ["listed-*"]}])
    assert [each["jobId"] for each in by_name["jobSummaryList"]] == [job]
    # the main node's end may cut the child off, which then has failed
    over = [
        batch.list_jobs(multiNodeJobId=job, jobStatus=status)["jobSummaryList"] for status in ("SUCCEEDED", "FAILED")
    ]
    children = sorted(itertools.chain(*over), key=lambda child: child["jobId"])
    assert [child["nodeProperties"]["nodeIndex"] for child in children] == [0, 1]
    assert children[0]["nodeProperties"]["isMainNode"] is True


def test_pages_follow_each_other_without_gap_or_repeat(batch: Any, shared_server: Serving) -> None:
    batch.register_job_definition(**definition("paged", nodes=1))
    jobs = {batch.submit_job(jobName="paged", jobQueue="default", jobDefinition="paged")["jobId"] for _ in range(5)}
    pages = batch.get_paginator("list_jobs").paginate(
        jobQueue="default", filters=[{"name": "JOB_NAME", "values": ["paged"]}], PaginationConfig={"PageSize": 2}
    )
    seen = [each["jobId"] for page in pages for each in page["jobSummaryList"]]
    assert len(seen) == 5 and set(seen) == jobs
    for job in jobs:
        shared_server.wait(job)


def test_terminating_ends_a_running_gang_and_keeps_the_reason(batch: Any, shared_server: Serving) -> None:
    batch.register_job_definition(**definition("endless", command=["sleep", "600"]))
    job = batch.submit_job(jobName="endless", jobQueue="default", jobDefinition="endless")
    shared_server.wait(job["jobId"], "RUNNING")
    batch.terminate_job(jobId=job["jobArn"], reason="enough")
    shared_server.wait(job["jobId"])
    described = batch.describe_jobs(jobs=[job["jobId"]])["jobs"][0]
    assert described["status"] == "FAILED" and described["isTerminated"] is True
    assert described["statusReason"] == "enough"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"properties": {"mainNode": 2}}, "mainNode is 2; it must be less than numNodes"),
        ({"properties": {"nodeRangeProperties": []}}, "0 node ranges"),
        ({"container": {"environment": [{"name": "AWS_BATCH_X", "value": "1"}]}}, "AWS_BATCH are reserved"),
        ({"timeout": {"attemptDurationSeconds": 5}}, "must be at least 60"),
        ({"retryStrategy": {"attempts": 11}}, "must be 1 to 10"),
        ({"type": "container"}, "type container needs containerProperties or ecsProperties, and only that"),
    ],
)
def test_bad_definitions_are_client_exceptions(batch: Any, change: dict[str, Any], message: str) -> None:
    with pytest.raises(batch.exceptions.ClientException, match=message) as caught:
        batch.register_job_definition(**{**definition("bad", **change)})
    assert caught.value.response["ResponseMetadata"]["HTTPStatusCode"] == 400


def test_bad_submissions_are_client_exceptions(batch: Any) -> None:
    batch.register_job_definition(**definition("submitted", properties={}))
    good = {"jobName": "x", "jobQueue": "default", "jobDefinition": "submitted"}
    override = {"nodePropertyOverrides": [{"targetNodes": "0:0", "containerOverrides": {}}]}
    for change, message in [
        ({"jobQueue": "nowhere"}, "does not exist"),
        ({"jobDefinition": "unknown"}, "does not exist"),
        ({"jobDefinition": "submitted:99"}, "does not exist"),
        ({"jobName": "-x"}, "jobName"),
        ({"nodeOverrides": override}, "Non matching targets - 0:0"),
        ({"arrayProperties": {"size": 3}}, "arrayProperties"),
    ]:
        with pytest.raises(ClientError, match=message) as caught:
            batch.submit_job(**{**good, **change})
        assert caught.value.response["Error"]["Code"] == "ClientException"


def test_operations_outside_the_set_are_named(batch: Any) -> None:
    with pytest.raises(ClientError, match="ListServiceJobs is not supported here; use SubmitJob"):
        batch.list_service_jobs(jobQueue="default")


@pytest.mark.parametrize(
    "body", [b"", b"[]", b"{", b'"x"', b'{"jobs": 3}', b'{"jobs": [null]}', b"\xff\xfe", b"[" * 5000]
)
def test_no_malformed_request_is_a_server_error(shared_server: Serving, body: bytes) -> None:
    for operation in ("describejobs", "submitjob", "registerjobdefinition", "listjobs", "terminatejob", "nonsense"):
        answer = httpx.post(f"{shared_server.url}/v1/{operation}", content=body)
        assert answer.status_code == 400, answer.text
        assert answer.headers["x-amzn-errortype"] == "ClientException" and "\n" not in answer.json()["message"]


def test_pages_from_elsewhere_can_not_reach_a_loopback_server(shared_server: Serving) -> None:
    assert httpx.get(f"{shared_server.url}/healthz").json()["status"] == "ok"
    rebound = httpx.get(f"{shared_server.url}/api/runs", headers={"Host": "evil.example"})
    foreign = httpx.post(f"{shared_server.url}/v1/listjobs", headers={"Origin": "http://evil.example"}, content="{}")
    assert rebound.status_code == foreign.status_code == 403


def test_the_native_api_describes_itself(shared_server: Serving) -> None:
    paths = httpx.get(f"{shared_server.url}/api/openapi.json").json()["paths"]
    assert {"/api/jobs/{reference}", "/api/runs/{name}/resume", "/api/runs/{name}/metrics"} <= set(paths)
