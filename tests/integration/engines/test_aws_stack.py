"""The CloudFormation template, created whole in moto, and ``muster aws`` that drives it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import boto3
import pytest
import yaml
from moto.batch import models as batch
from moto.batch.utils import lowercase_first_key
from moto.cloudformation.models import cloudformation_backends
from moto.cloudformation.parsing import ResourceMap
from moto.ec2.models import ec2_backends
from moto.ec2.models.route_tables import RouteTable
from moto.efs.models import AccessPoint
from moto.server import ThreadedMotoServer

from orchestrator.domain.hosts import Limit, Placement, Queued
from orchestrator.domain.resources import Resources
from orchestrator.engines.aws_batch.config import load_config
from orchestrator.engines.aws_batch.engine import AwsBatchEngine
from orchestrator.engines.aws_batch.stack import StackEvent, first_failure
from tests.conftest import REPOSITORY, call_muster
from tests.support.engines.bench import make_gang


def _definition(
    cls: Any, /, resource_name: str, cloudformation_json: dict[str, Any], account_id: str, region_name: str, **_: Any
) -> Any:
    """moto takes every definition of a template for one of a single container; this passes on what it is."""
    properties = cloudformation_json["Properties"]
    supplied: dict[str, Any] = dict(
        def_name=resource_name,
        parameters={},
        _type=properties["Type"],
        tags={},
        retry_strategy=lowercase_first_key(properties["RetryStrategy"]),
        container_properties=None,
        node_properties=lowercase_first_key(properties["NodeProperties"]),
        eks_properties=None,
        timeout=lowercase_first_key(properties["Timeout"]),
        platform_capabilities=None,
        propagate_tags=properties["PropagateTags"],
    )
    return batch.batch_backends[account_id][region_name].register_job_definition(**supplied)


_environment_of = batch.ComputeEnvironment.create_from_cloudformation_json


def _environment(
    cls: Any, /, resource_name: str, cloudformation_json: dict[str, Any], account_id: str, region_name: str, **_: Any
) -> Any:
    """moto wants a service role; AWS takes its service-linked one, which it makes with the first compute environment."""
    roles = batch.batch_backends[account_id][region_name].iam_backend
    made = (role for role in roles.roles.values() if role.name == "AWSServiceRoleForBatch")
    role = next(made, None) or roles.create_service_linked_role("batch.amazonaws.com", "", "")
    properties = {"ServiceRole": role.arn, **cloudformation_json["Properties"]}
    return _environment_of(resource_name, {"Properties": properties}, account_id, region_name)


def _delete_table(table: RouteTable, account: str, region: str) -> None:
    ec2_backends[account][region].route_tables.pop(table.id, None)


_delete = ResourceMap.delete


def _delete_stack(resources: ResourceMap) -> None:
    """moto does not know the newer word for a resource that outlives its stack, where that was ever whole."""
    for resource in resources._resource_json_map.values():
        if resource.get("DeletionPolicy") == "RetainExceptOnCreate":
            resource["DeletionPolicy"] = "Retain"
    _delete(resources)


@contextmanager
def moto_server() -> Iterator[str]:
    """The URL of a moto that has no account's state yet."""
    with pytest.MonkeyPatch.context() as patch:
        reference = property(lambda point: point.access_point_id)  # what `Ref` of one gives
        patch.setattr(AccessPoint, "physical_resource_id", reference, raising=False)
        patch.setattr(RouteTable, "delete", _delete_table, raising=False)
        patch.setattr(batch.JobDefinition, "create_from_cloudformation_json", classmethod(_definition))
        patch.setattr(batch.ComputeEnvironment, "create_from_cloudformation_json", classmethod(_environment))
        patch.setattr(ResourceMap, "delete", _delete_stack)
        server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        try:
            host, port = server.get_host_and_port()
            url = f"http://{host}:{port}"
            post(url, "/moto-api/reset", {})
            post(url, "/moto-api/config", {"batch": {"use_docker": False}})
            yield url
        finally:
            server.stop()


def post(url: str, path: str, body: object) -> None:
    request = urllib.request.Request(url + path, json.dumps(body).encode(), {"Content-Type": "application/json"})
    urllib.request.urlopen(request, timeout=30).read()


# both are in the template, and moto says that it can't make them
pytestmark = pytest.mark.filterwarnings("ignore:Tried to parse AWS")

TEMPLATE = REPOSITORY / "containers" / "aws" / "muster.yaml"
REGION = "us-east-1"
NO_CONFIGURATION = dict.fromkeys(("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"), os.devnull)
NO_CONFIGURATION["AWS_EC2_METADATA_DISABLED"] = "true"
# moto does not split the default of a list, and knows few images
PARAMETERS = ["--parameter", "InstanceTypes=g6.12xlarge", "--parameter", "WorkstationImage=ami-12c6146b"]
NO_STACK = "muster: there is no stack {} in us-east-1; create it with `muster aws up`\n"
WHOLE = [f"--parameter={name}=true" for name in ("Workstation", "InterfaceEndpoints", "UseEfa")]


class Loader(yaml.SafeLoader):
    """Takes ``!Ref`` and the like for nothing."""


Loader.add_multi_constructor("!", lambda loader, tag, node: None)
RESOURCES = yaml.load(TEMPLATE.read_text(), Loader)["Resources"]


class Account:
    """moto as one account of AWS, a home directory, and the command."""

    def __init__(self, url: str, home: Path) -> None:
        self.url, self.home = url, home
        self.env = {**NO_CONFIGURATION, "AWS_DEFAULT_REGION": REGION, "AWS_ENDPOINT_URL": url}
        self.env |= dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "any")

    def client(self, service: str) -> Any:
        key = {"aws_access_key_id": "a", "aws_secret_access_key": "b"}
        return boto3.client(service, endpoint_url=self.url, region_name=REGION, **key)

    def muster(self, *arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
        return call_muster("aws", *arguments, home=self.home, **{**self.env, **env})

    def outputs(self) -> dict[str, str]:
        [stack] = self.client("cloudformation").describe_stacks(StackName="muster")["Stacks"]
        return {each["OutputKey"]: each["OutputValue"] for each in stack["Outputs"]}

    def physical(self, logical: str) -> str:
        resources = self.client("cloudformation").describe_stack_resources(StackName="muster")["StackResources"]
        return str(next(each["PhysicalResourceId"] for each in resources if each.get("LogicalResourceId") == logical))


@pytest.fixture(scope="module")
def account(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Account]:
    """With the whole stack in it: workstation, endpoints and EFA too."""
    with moto_server() as url:
        account = Account(url, tmp_path_factory.mktemp("home"))
        made = account.muster("up", "--yes", *PARAMETERS, *WHOLE)
        assert made.returncode == 0, made.stdout + made.stderr
        yield account


def test_the_template_is_clean() -> None:
    linter = Path(sys.executable).parent / "cfn-lint"
    done = subprocess.run([linter, "--include-checks", "I", "--", str(TEMPLATE)], capture_output=True, text=True)
    problems = [line for line in done.stdout.splitlines() if line[:1] in "EW"]
    assert done.returncode == 0, done.stdout + done.stderr
    assert problems == [] and TEMPLATE.stat().st_size < 51_200, (problems, "CloudFormation takes no more in a request")


def test_every_resource_is_created_and_the_outputs_make_the_engine_s_configuration(account: Account) -> None:
    resources = account.client("cloudformation").describe_stack_resources(StackName="muster")["StackResources"]
    resources = [each for each in resources if "LogicalResourceId" in each]
    made = {each["LogicalResourceId"] for each in resources}
    # moto has no such resources; each is one line of the template, which cfn-lint reads
    assert RESOURCES.keys() - made == {"PlacementGroup", "GangTalksByEfa"} and len(made) > 40
    assert {each["ResourceStatus"] for each in resources} == {"CREATE_COMPLETE"}
    config, outputs = load_config(account.home), account.outputs()
    assert (config.region, config.job_queue, config.stack) == (REGION, "muster", "muster")
    assert config.image == f"{outputs['RepositoryUri']}:latest" and config.log_group == "/muster/muster"
    assert config.file_system == account.physical("FileSystem") and str(config.access_point).startswith("fsap-")
    assert config.job_role == outputs["JobRoleArn"] and (config.efa, config.max_vcpus) == (True, 256)
    assert outputs["WorkstationUrl"].endswith(":8443/#muster")


def test_the_gang_may_talk_to_itself_and_the_volume_to_the_gang_alone(account: Account) -> None:
    ec2 = account.client("ec2")

    def rules(logical: str) -> list[tuple[Any, ...]]:
        [group] = ec2.describe_security_groups(GroupIds=[account.physical(logical)])["SecurityGroups"]
        found = []
        for rule in group["IpPermissions"]:
            sources = [each["GroupId"] for each in rule["UserIdGroupPairs"]]
            sources += [each["CidrIp"] for each in rule["IpRanges"]]
            found += [(rule["IpProtocol"], rule.get("FromPort"), source) for source in sources]
        return sorted(found)

    gang, desk = account.physical("GangSecurityGroup"), account.physical("WorkstationSecurityGroup")
    assert [(rule[0], rule[2]) for rule in rules("GangSecurityGroup")] == [("-1", gang)], "themselves alone"
    assert rules("VolumeSecurityGroup") == sorted([("tcp", 2049, gang), ("tcp", 2049, desk)])
    nobody = [(protocol, 8443, "127.0.0.1/32") for protocol in ("tcp", "udp")]
    assert rules("WorkstationSecurityGroup") == nobody, "until a person says who"


def test_private_subnets_have_the_volume_and_a_way_out(account: Account) -> None:
    ec2, efs = account.client("ec2"), account.client("efs")
    private = [account.physical(f"PrivateSubnet{number}") for number in (1, 2)]
    targets = efs.describe_mount_targets(FileSystemId=account.physical("FileSystem"))["MountTargets"]
    assert sorted(each["SubnetId"] for each in targets) == sorted(private), "one in each"
    [point] = efs.describe_access_points(FileSystemId=account.physical("FileSystem"))["AccessPoints"]
    assert (point["PosixUser"]["Uid"], point["RootDirectory"]["Path"]) == (1000, "/muster")
    [table] = ec2.describe_route_tables(RouteTableIds=[account.physical("PrivateRoutes")])["RouteTables"]
    out = next(route for route in table["Routes"] if route.get("DestinationCidrBlock") == "0.0.0.0/0")
    assert out["NatGatewayId"] == account.physical("NatGateway")
    backend = ec2_backends["123456789012"][REGION]  # DescribeRouteTables does not tell what a template associates
    associations = [(each.route_table_id, each.subnet_id) for each in backend.subnet_associations.values()]
    assert {subnet for table_id, subnet in associations if table_id == table["RouteTableId"]} == set(private)
    zones = {each["AvailabilityZone"] for each in ec2.describe_subnets(SubnetIds=private)["Subnets"]}
    assert len(zones) == 2
    services = {each["ServiceName"].rpartition(".")[2] for each in ec2.describe_vpc_endpoints()["VpcEndpoints"]}
    assert services == {"s3", "api", "dkr", "logs"}


def test_batch_runs_multi_node_jobs_on_instances_of_one_zone(account: Account) -> None:
    batch = account.client("batch")
    [queue] = batch.describe_job_queues(jobQueues=["muster"])["jobQueues"]
    [order] = queue["computeEnvironmentOrder"]
    named = {"computeEnvironments": [order["computeEnvironment"]]}
    [described] = batch.describe_compute_environments(**named)["computeEnvironments"]
    resources = described["computeResources"]
    assert (described["type"], resources["type"], int(resources["maxvCpus"])) == ("MANAGED", "EC2", 256)
    assert resources["subnets"] == [account.physical("PrivateSubnet1")]
    assert resources["instanceTypes"] == ["g6.12xlarge"]
    assert resources["securityGroupIds"] == [account.physical("GangSecurityGroup")]
    assert resources["instanceRole"].endswith(account.physical("InstanceProfile"))
    [definition] = batch.describe_job_definitions(jobDefinitionName="muster-check")["jobDefinitions"]
    assert definition["type"] == "multinode"
    named = {"LaunchTemplateId": account.physical("LaunchTemplate")}
    [template] = account.client("ec2").describe_launch_template_versions(**named)["LaunchTemplateVersions"]
    data = template["LaunchTemplateData"]
    assert data["MetadataOptions"]["HttpTokens"] == "required"
    assert data["NetworkInterfaces"][0]["InterfaceType"] == "efa"


def test_the_compute_environment_can_be_changed_where_it_is_and_a_failed_create_leaves_no_volume() -> None:
    """Moto allows it and AWS does not: an update in place with a custom service role."""
    environment, volume = RESOURCES["ComputeEnvironment"]["Properties"], RESOURCES["FileSystem"]
    assert environment["ReplaceComputeEnvironment"] is False and "ServiceRole" not in environment
    assert (volume["DeletionPolicy"], volume["UpdateReplacePolicy"]) == ("RetainExceptOnCreate", "Retain")


def test_roles_allow_no_more_than_they_must(account: Account) -> None:
    iam = account.client("iam")
    unlimited = {"batch:Describe", "batch:ListJobs", "ecr:GetAuthorizationToken"}
    documents = []
    for logical in ("JobRole", "InstanceRole", "WorkstationRole"):
        role = account.physical(logical)
        for name in iam.list_role_policies(RoleName=role)["PolicyNames"]:
            documents.append(iam.get_role_policy(RoleName=role, PolicyName=name)["PolicyDocument"])
    arn = account.outputs()["ControllerPolicyArn"]
    version = iam.get_policy(PolicyArn=arn)["Policy"]["DefaultVersionId"]
    documents.append(iam.get_policy_version(PolicyArn=arn, VersionId=version)["PolicyVersion"]["Document"])
    whole = [yaml.safe_load(each) if isinstance(each, str) else each for each in documents]  # moto prints a Python dict
    statements = [statement for document in whole for statement in document["Statement"]]
    assert len(statements) >= 11
    for statement in statements:
        actions = statement["Action"] if isinstance(statement["Action"], list) else [statement["Action"]]
        assert not any("*" in action for action in actions), statement
        if statement["Resource"] == "*":
            assert all(any(action.startswith(each) for each in unlimited) for action in actions), statement
    [volume] = whole[0]["Statement"]
    assert volume["Action"] == ["elasticfilesystem:ClientMount", "elasticfilesystem:ClientWrite"]
    assert account.physical("AccessPoint") in json.dumps(volume["Condition"])
    assert iam.list_attached_role_policies(RoleName=account.physical("JobRole"))["AttachedPolicies"] == []


def test_the_engine_works_with_what_up_wrote(account: Account, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, value in account.env.items():
        monkeypatch.setenv(name, value)
    engine = AwsBatchEngine(account.home)
    assert engine.capacity() == Queued(Limit("aws-batch/muster", Resources(256.0, 64, 256 * 32 * 1024)))
    gang = make_gang(
        tmp_path,
        job="11111111-2222-4333-8444-555555555555",
        commands=[["true"]] * 2,
        environments=[{"MUSTER_ON_CHILD_FAILURE": "restart"}] * 2,
        placements=[Placement("aws-batch/muster", ("0",), 4, 4096)] * 2,
        grace=30.0,
        containers=[{"image": "muster"}] * 2,
        title="ant",
    )
    handle = engine.launch(engine.plan(gang))
    job = handle.facts["aws"]
    filters = [{"name": "JOB_NAME", "values": [f"ant-{gang.job}-1-1"]}]
    [listed] = account.client("batch").list_jobs(jobQueue="muster", filters=filters)["jobSummaryList"]
    assert listed["jobId"] == job and engine.launch(engine.plan(gang)) == handle
    [definition] = account.client("batch").describe_job_definitions(jobDefinitionName="muster-ant")["jobDefinitions"]
    assert definition["type"] == "multinode" and definition["tags"]["muster:digest"]


def test_status_lists_the_resources_and_writes_the_engine_s_configuration(account: Account) -> None:
    shown = account.muster("status")
    assert shown.returncode == 0, shown.stderr
    assert "muster in us-east-1: CREATE_COMPLETE" in shown.stdout and "not pushed yet" in shown.stdout
    manifest = json.dumps({"schemaVersion": 2, "config": {"digest": "sha256:0"}, "layers": []})
    image = {"imageManifestMediaType": "application/vnd.docker.distribution.manifest.v2+json", "imageTag": "latest"}
    account.client("ecr").put_image(repositoryName="muster", imageManifest=manifest, **image)
    assert "image " in account.muster("status").stdout and "not pushed" not in account.muster("status").stdout
    before = (account.home / "aws.json").read_text()
    (account.home / "aws.json").unlink()
    reported = json.loads(account.muster("status", "--json", "--write").stdout)
    assert (account.home / "aws.json").read_text() == before
    (account.home / "aws.json").write_text(json.dumps({**json.loads(before), "poll": "2"}))
    refused = account.muster("status", "--write").stderr
    assert refused.splitlines()[-1].endswith("aws.json: poll: expected a number, found a string ('2')")
    (account.home / "aws.json").write_text(before)
    assert reported["queue"]["status"] == "VALID" and reported["outputs"]["JobQueue"] == "muster"
    assert account.muster("status", "--stack-name", "other").stderr == NO_STACK.format("other")


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["--parameter", "InstanceType=g6.xlarge"], "no such parameter; did you mean InstanceTypes?"),
        (["--template", "/no/such/file"], "template /no/such/file is missing"),
    ],
)
def test_a_wrong_call_is_refused_before_anything_is_asked(account: Account, arguments: list[str], output: str) -> None:
    refused = account.muster("up", *arguments)
    assert refused.returncode == 1 and output in refused.stderr and refused.stderr.count("\n") == 1


def test_without_credentials_or_region_it_says_what_to_do(account: Account) -> None:
    refused = account.muster("status", AWS_ACCESS_KEY_ID="", AWS_SECRET_ACCESS_KEY="")
    output = "muster: AWS: no credentials; run `aws configure`, or set AWS_PROFILE\n"
    assert (refused.returncode, refused.stderr) == (1, output)
    refused = account.muster("status", AWS_DEFAULT_REGION="")
    assert refused.stderr == "muster: AWS: no region; give --region, or set AWS_DEFAULT_REGION\n"
    refused = account.muster("status", AWS_ENDPOINT_URL="http://127.0.0.1:9", AWS_MAX_ATTEMPTS="1")
    assert refused.returncode == 1 and "Could not connect" in refused.stderr and refused.stderr.count("\n") == 1


def test_down_asks_first_removes_the_stack_and_says_that_the_volume_stays(tmp_path: Path) -> None:
    with moto_server() as url:
        account = Account(url, tmp_path)
        made = account.muster("up", "--yes", *PARAMETERS)
        assert made.returncode == 0 and "CREATE_COMPLETE" in made.stdout, made.stderr
        assert "aws ecr get-login-password" in made.stdout and (tmp_path / "aws.json").exists()
        assert "WorkstationUrl" not in account.outputs(), "only on request"
        volume = account.physical("FileSystem")
        requested = account.muster("down")  # nobody answers
        assert requested.returncode == 1 and f"file system {volume}" in requested.stdout
        assert account.client("cloudformation").describe_stacks(StackName="muster")["Stacks"]
        [stack] = cloudformation_backends["123456789012"][REGION].stacks.values()
        stack.status = "ROLLBACK_COMPLETE"
        again = account.muster("up", "--yes", *PARAMETERS)
        output = "muster: stack muster is in ROLLBACK_COMPLETE and can't be updated; "
        assert again.returncode == 1
        assert again.stderr == f"{output}remove it with `muster aws down`, then try again\n"
        gone = account.muster("down", "--yes", "--json")
        assert gone.returncode == 0, gone.stderr
        assert json.loads(gone.stdout) == {"stack": "muster", "region": REGION, "fileSystem": volume}
        assert not (tmp_path / "aws.json").exists()
        networks = [each["CidrBlock"] for each in account.client("ec2").describe_vpcs()["Vpcs"]]
        assert "10.20.0.0/16" not in networks and account.client("efs").describe_file_systems()["FileSystems"]
        assert account.muster("down", "--yes").stderr == NO_STACK.format("muster")


def test_the_resource_that_failed_first_is_named_not_those_that_it_took_along() -> None:
    def event(resource: str, status: str, reason: str = "") -> StackEvent:
        return StackEvent("12:00:00", resource, f"AWS::EC2::{resource}", status, reason)

    events = [
        event("Vpc", "CREATE_COMPLETE"),
        event("Subnet", "CREATE_FAILED", "Resource creation cancelled"),
        event("NatGateway", "CREATE_FAILED", "The maximum number of addresses has been reached."),
        event("muster", "ROLLBACK_IN_PROGRESS", "The following resource(s) failed to create: [NatGateway]."),
    ]
    output = "NatGateway (AWS::EC2::NatGateway): The maximum number of addresses has been reached."
    assert first_failure(events) == output
