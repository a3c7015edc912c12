"""What clients that were written for AWS alone find here: its defaults, its shapes, and plain words for what is not here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import boto3
import httpx
import pytest
from botocore import UNSIGNED
from botocore.config import Config
from botocore.exceptions import ClientError

from tests.conformance.aws import Batch, refused
from tests.conformance.streams import client_of
from tests.conftest import Serving


@pytest.fixture(scope="module")
def batch(shared_server: Serving) -> Batch:
    return Batch(shared_server)


# -- other services ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("service", "call", "code"),
    [
        ("s3", lambda s3: s3.list_buckets(), "NotImplemented"),
        ("s3", lambda s3: s3.put_object(Bucket="b", Key="a/k", Body=b"x" * 100_000), "NotImplemented"),
        ("s3", lambda s3: s3.head_object(Bucket="b", Key="k"), "501"),
        ("sts", lambda sts: sts.get_caller_identity(), "InvalidAction"),
        ("iam", lambda iam: iam.get_user(), "InvalidAction"),
        ("ec2", lambda ec2: ec2.describe_instances(), "InvalidAction"),
        ("ecs", lambda ecs: ecs.list_clusters(), "UnknownOperationException"),
        ("dynamodb", lambda dynamodb: dynamodb.list_tables(), "UnknownOperationException"),
        ("cloudwatch", lambda cloudwatch: cloudwatch.list_metrics(), "UnknownOperationException"),
        ("lambda", lambda functions: functions.list_functions(), "UnknownOperationException"),
        ("efs", lambda efs: efs.describe_file_systems(), "UnknownOperationException"),
        ("route53", lambda route53: route53.list_hosted_zones(), "InvalidAction"),
    ],
)
def test_a_service_that_is_not_here_says_so_in_its_own_protocol(
    shared_server: Serving, service: str, call: Callable[[Any], Any], code: str
) -> None:
    with pytest.raises(ClientError) as caught:
        call(client_of(shared_server.url, service))
    error = caught.value.response["Error"]
    assert error["Code"] == code
    if code != "501":  # an answer to HEAD has no body
        assert "this is Muster" in error["Message"] and "AWS_ENDPOINT_URL_BATCH" in error["Message"]


def test_requests_that_are_not_signed_or_signed_in_the_address_are_told_too(shared_server: Serving) -> None:
    unsigned = boto3.client(
        "sts", endpoint_url=shared_server.url, region_name="us-east-1", config=Config(signature_version=UNSIGNED)
    )
    with pytest.raises(ClientError, match="this is Muster"):
        unsigned.assume_role_with_web_identity(RoleArn="a" * 20, RoleSessionName="me", WebIdentityToken="token")
    signed = boto3.client(
        *("s3", "us-east-1"),
        endpoint_url=shared_server.url,
        aws_access_key_id="any",
        aws_secret_access_key="any",
        config=Config(signature_version="s3v4"),
    )
    answer = httpx.get(signed.generate_presigned_url("get_object", Params={"Bucket": "b", "Key": "k"}))
    assert answer.status_code == 501 and "<Code>NotImplemented</Code>" in answer.text


# -- compute environments ---------------------------------------------------------------------------------------------


def test_the_built_in_compute_environment_looks_like_one_of_awss(batch: Batch) -> None:
    [found] = batch.api.describe_compute_environments(computeEnvironments=["local"])["computeEnvironments"]
    assert (found["type"], found["state"], found["status"]) == ("MANAGED", "ENABLED", "VALID")
    assert found["statusReason"] == "ComputeEnvironment Healthy" and found["containerOrchestrationType"] == "ECS"
    resources = found["computeResources"]
    assert resources["type"] == "EC2", "Metaflow reads it unguarded"
    assert resources["minvCpus"] == resources["desiredvCpus"] == resources["maxvCpus"] == 8
    assert resources["instanceTypes"] == ["optimal"] and resources["subnets"] == [] == resources["securityGroupIds"]
    assert found["ecsClusterArn"].startswith("arn:aws:ecs:us-east-1:000000000000:cluster/AWSBatch-local-")
    assert found["uuid"] in found["ecsClusterArn"] and found["serviceRole"] and found["updatePolicy"]
    batch.api.create_compute_environment(computeEnvironmentName="unmanaged", type="UNMANAGED", unmanagedvCpus=4)
    [found] = batch.api.describe_compute_environments(computeEnvironments=["unmanaged"])["computeEnvironments"]
    assert (found["type"], found["unmanagedvCpus"]) == ("UNMANAGED", 4)
    assert "computeResources" not in found and found["ecsClusterArn"]
    batch.api.update_compute_environment(computeEnvironment="unmanaged", state="DISABLED")
    batch.api.delete_compute_environment(computeEnvironment="unmanaged")


# -- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "prefix",
    ["arn:aws:batch:eu-west-1:000000000000:", "arn:aws:batch:us-east-1:123456789012:", "arn:aws:ecs:us-east-1:1:"],
)
def test_arns_of_other_accounts_regions_and_services_are_refused(batch: Batch, prefix: str) -> None:
    api = batch.api
    for call in (
        lambda: api.submit_job(jobName="a", jobQueue=f"{prefix}job-queue/default", jobDefinition="any"),
        lambda: api.submit_job(jobName="a", jobQueue="default", jobDefinition=f"{prefix}job-definition/any:1"),
        lambda: api.describe_jobs(jobs=[f"{prefix}job/6c4a7d0e-0000-4000-8000-000000000000"]),
        lambda: api.describe_job_queues(jobQueues=[f"{prefix}job-queue/default"]),
        lambda: api.describe_compute_environments(computeEnvironments=[f"{prefix}compute-environment/local"]),
        lambda: api.tag_resource(resourceArn=f"{prefix}job-queue/default", tags={"a": "b"}),
    ):
        with refused("is not an ARN of this controller"):
            call()
    with refused("is the ARN of a compute-environment, not of a job-queue"):
        api.list_jobs(jobQueue="arn:aws:batch:us-east-1:000000000000:compute-environment/local")
