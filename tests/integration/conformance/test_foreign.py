"""What clients that were written for AWS alone find here: its defaults, its shapes, and plain words for what is not here."""

from __future__ import annotations

import json
import os
import pwd
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import boto3
import httpx
import pytest
from botocore import UNSIGNED
from botocore.config import Config
from botocore.exceptions import ClientError

from tests.conftest import Serving, wait_for
from tests.support.conformance.aws import Batch, container, refused
from tests.support.conformance.streams import client_of
from tests.support.processes import await_end, parent, processes_of

SECRET = "hunter2 is secret"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """A server that gives secrets to jobs."""
    folder = tmp_path_factory.mktemp("foreign")
    (folder / "secrets.json").touch(0o600)
    (folder / "secrets.json").write_text(json.dumps({"db": SECRET}))
    with Serving(folder / "home", "--cpus", "8", "--secrets", str(folder / "secrets.json")) as serving:
        yield serving


@pytest.fixture(scope="module")
def batch(server: Serving) -> Batch:
    return Batch(server)


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
def test_another_service_is_refused_its_way(
    server: Serving, service: str, call: Callable[[Any], Any], code: str
) -> None:
    with pytest.raises(ClientError) as caught:
        call(client_of(server.url, service))
    error = caught.value.response["Error"]
    assert error["Code"] == code
    if code != "501":  # an answer to HEAD has no body
        assert "this is Muster" in error["Message"] and "AWS_ENDPOINT_URL_BATCH" in error["Message"]


def test_requests_that_are_not_signed_or_signed_in_the_address_are_refused_too(server: Serving) -> None:
    unsigned_as = Config(signature_version=UNSIGNED)
    unsigned = boto3.client("sts", endpoint_url=server.url, region_name="us-east-1", config=unsigned_as)
    with pytest.raises(ClientError, match="this is Muster"):
        unsigned.assume_role_with_web_identity(RoleArn="a" * 20, RoleSessionName="me", WebIdentityToken="token")
    key = {"aws_access_key_id": "any", "aws_secret_access_key": "any", "config": Config(signature_version="s3v4")}
    signed = boto3.client("s3", "us-east-1", endpoint_url=server.url, **key)
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
    assert found["ecsClusterArn"] == "arn:aws:ecs:us-east-1:000000000000:cluster/AWSBatch-local"
    assert found["uuid"] and found["serviceRole"] and found["updatePolicy"]
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


# -- as in a container ------------------------------------------------------------------------------------------------


def test_a_job_of_the_api_starts_in_an_empty_directory_with_few_variables(batch: Batch) -> None:
    script = "ls -A; pwd; touch left-behind; ls -A; ls -A $HOME; env"
    definitions = (batch.single("iso-any", script, env={"MINE": "1"}),)
    definitions += (batch.multinode("iso-muster", script, 1, container={"image": "muster"}),)
    jobs = [batch.submit(each) for each in definitions]
    for job in jobs:
        assert batch.wait(job)["status"] == "SUCCEEDED"
        directory, *listed = [line for line in batch.lines(job) if "=" not in line]
        assert listed == ["left-behind"], "empty at first, and so is its home"
        variables = dict(line.split("=", 1) for line in batch.lines(job) if "=" in line)
        assert Path(variables["HOME"]).parent == Path(directory).parent
        assert not Path(directory).parent.exists(), "removed with the attempt"
        assert not [name for name in variables if name.startswith(("PYTEST", "VIRTUAL", "MUSTER_HOME", "USER"))]
        own = [part for part in variables["PATH"].split(":") if (Path(part) / "muster").exists()]
        assert len(own) == (job == jobs[1]), "Muster's own environment is on PATH in Muster's own image only"
        assert variables["PATH"].endswith("/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin")
        assert variables.get("MINE") == ("1" if job == jobs[0] else None)


def test_a_job_may_keep_its_directory(batch: Batch) -> None:
    job = batch.submit(batch.single("iso-kept", "pwd; touch result", env={"MUSTER_KEEP_DIRECTORY": "1"}))
    batch.wait(job)
    directory, output = batch.lines(job)
    assert (Path(directory) / "result").exists() and str(Path(directory).parent) in output
    shutil.rmtree(Path(directory).parent)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_job_runs_as_the_user_that_it_names(batch: Batch) -> None:
    script = "id -u; id -g; touch here; [ -w $HOME ] && exec sleep 600"
    job = batch.submit(batch.single("iso-user", script, container={"user": "nobody"}))
    numbers = wait_for(lambda: len(lines := batch.lines(job)) > 1 and lines, what="its first lines")
    nobody = pwd.getpwnam("nobody")
    assert numbers[:2] == [str(nobody.pw_uid), str(nobody.pw_gid)]
    [rank] = [pid for pid in processes_of(batch.server.home) if Path(f"/proc/{pid}").stat().st_uid == nobody.pw_uid]
    os.kill(parent(rank), signal.SIGKILL)
    await_end(rank)  # its supervisor is gone
    assert batch.wait(job)["status"] == "FAILED"
    ours = {"MUSTER_ON_CHILD_FAILURE": "restart"}  # a job of our own kind, which has no directory of its own
    job = batch.submit(batch.single("iso-ours", "id -u; echo $HOME", env=ours, container={"user": "nobody"}))
    assert batch.wait(job)["status"] == "SUCCEEDED" and batch.lines(job) == [str(nobody.pw_uid), nobody.pw_dir]
    # who is this machine's loses root's rights, also where the group is the image's
    job = batch.submit(batch.single("iso-group", "id -u; id -g", container={"user": "nobody:no-such-group"}))
    assert batch.wait(job)["status"] == "SUCCEEDED"
    gid = nobody.pw_gid
    note = f"muster: group no-such-group is not used: this machine has no such group; the job runs with group {gid}"
    assert sorted(batch.lines(job)) == sorted([note, str(nobody.pw_uid), str(gid)])


def test_the_user_of_an_image_that_is_not_used_is_passed_over_with_a_note_in_the_log(batch: Batch) -> None:
    job = batch.submit(batch.single("iso-image", "id -u", container={"user": "efauser"}))
    assert batch.wait(job)["status"] == "SUCCEEDED" and batch.describe(job)["container"]["user"] == "efauser"
    why = "the controller does not run as root" if os.geteuid() else "this machine has no user efauser"
    note = f"muster: user efauser is not used: nodes run without the image, and {why}"
    assert sorted(batch.lines(job)) == sorted([note, str(os.geteuid())])


def test_secrets_reach_the_job_and_nothing_else(batch: Batch) -> None:
    secrets = [{"name": "PASSWORD", "valueFrom": "arn:aws:secretsmanager:us-east-1:123456789012:secret:db-AbCdEf"}]
    definition = batch.single("secret", 'printf %s "$PASSWORD" | wc -c', container={"secrets": secrets})
    job = batch.submit(definition)
    assert batch.wait(job)["status"] == "SUCCEEDED" and batch.lines(job) == [str(len(SECRET))]
    detail = batch.describe(job)
    assert detail["container"]["secrets"] == secrets and SECRET not in json.dumps(detail)
    written = [path for path in batch.server.home.rglob("*") if path.is_file()]
    assert any(path.name.startswith("muster.db") for path in written)
    assert [path for path in written if SECRET.encode() in path.read_bytes()] == []
    other = batch.single("secret", "true", container={"secrets": [{"name": "A", "valueFrom": "other"}]})
    with refused("secret A: 'other' is not in"):
        batch.submit(other)


# -- ecsProperties ----------------------------------------------------------------------------------------------------


def test_ecs_properties_of_one_container_run_and_are_shown_as_they_came(batch: Batch) -> None:
    only = {**container("echo $A $B", {"env": {"A": "1"}}), "name": "main"}
    ecs: dict[str, Any] = {"taskProperties": [{"containers": [only], "taskRoleArn": "arn:aws:iam::1:role/any"}]}
    change = {"name": "main", "environment": [{"name": "B", "value": "2"}]}
    override = {"taskProperties": [{"containers": [change]}]}
    single = batch.register("ecs", "container", ecsProperties=ecs)
    [shown] = batch.api.describe_job_definitions(jobDefinitions=[single])["jobDefinitions"]
    [task] = shown["ecsProperties"]["taskProperties"]
    assert task["taskRoleArn"] == "arn:aws:iam::1:role/any" and task["volumes"] == []
    assert {key: task["containers"][0][key] for key in only} == only and task["containers"][0]["secrets"] == []
    job = batch.submit(single, ecsPropertiesOverride=override)
    detail = batch.wait(job)
    [task] = detail["ecsProperties"]["taskProperties"]
    [shown] = task["containers"]
    assert re.fullmatch(r"arn:aws:ecs:us-east-1:000000000000:task/AWSBatch-local/[0-9a-f]{32}", task["taskArn"])
    assert detail["container"] == {} and task["taskRoleArn"] == "arn:aws:iam::1:role/any"
    assert (shown["name"], shown["exitCode"]) == ("main", 0)
    assert batch.stream(shown["logStreamName"]) == ["1 2"]
    [attempt] = detail["attempts"]
    assert attempt["taskProperties"][0]["containers"][0]["exitCode"] == 0 and attempt["container"] == {}
    ranges = [{"targetNodes": "0:", "ecsProperties": ecs}]
    gang = batch.multinode("ecs-gang", "", 2, ranges=ranges)
    overrides = {"nodePropertyOverrides": [{"targetNodes": "0:", "ecsPropertiesOverride": override}]}
    job = batch.submit(gang, nodeOverrides=overrides)
    [entry] = batch.wait(job)["nodeProperties"]["nodeRangeProperties"]
    assert "container" not in entry and entry["ecsProperties"]["taskProperties"][0]["containers"][0]["name"] == "main"
    node = batch.describe(f"{job}#0")["ecsProperties"]["taskProperties"][0]["containers"][0]
    assert batch.stream(node["logStreamName"]) == ["1 2"]
    for containers, message in (([only, only], "2 containers"), ([{**only, "essential": False}], "is essential")):
        with refused(message):
            batch.register("ecs-bad", "container", ecsProperties={"taskProperties": [{"containers": containers}]})
    with refused("use ecsPropertiesOverride"):
        batch.submit(single, containerOverrides={"command": ["true"]})
    with refused("there is no container 'other'"):
        batch.submit(single, ecsPropertiesOverride={"taskProperties": [{"containers": [{"name": "other"}]}]})


# -- what a definition must say ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lacking", "message"),
    [
        ("image", "Container image is not provided."),
        ("VCPU", "vCPU is not provided."),
        ("MEMORY", "Memory is not provided."),
    ],
)
def test_a_definition_without_image_or_resources_is_refused_at_once(batch: Batch, lacking: str, message: str) -> None:
    supplied = container("true", {})
    supplied.pop(lacking, None)
    supplied["resourceRequirements"] = [each for each in supplied["resourceRequirements"] if each["type"] != lacking]
    with refused("Error executing request, Exception : ", message):
        batch.register("lacking", "container", containerProperties=supplied)
    with refused("Error executing request, Exception : ", message):
        batch.multinode("lacking", "", ranges=[{"targetNodes": "0:", "container": supplied}])


def test_variables_with_names_that_no_shell_has_reach_the_job(batch: Batch) -> None:
    env = {"my.var": "1", "A b": "2", "BASH_FUNC_x%%": "() { :; }"}
    script = f"import os; print([os.environ.get(each) for each in {list(env)}])"
    definition = batch.register(
        "names",
        "container",
        containerProperties={
            "image": "any",
            "command": ["python3", "-c", script],
            "environment": [{"name": name, "value": value} for name, value in env.items()],
            "resourceRequirements": [{"type": "VCPU", "value": "1"}, {"type": "MEMORY", "value": "128"}],
        },
    )
    job = batch.submit(definition)
    assert batch.wait(job)["status"] == "SUCCEEDED" and batch.lines(job) == [str(list(env.values()))]
