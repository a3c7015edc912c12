"""Fargate: what AWS takes there is taken, shown and runs on the queue's engine; what AWS refuses there is refused. EKS is refused by name."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support.conformance.aws import PREFIX, Batch, refused

FARGATE = {"platformCapabilities": ["FARGATE"]}
CONTAINER: dict[str, Any] = {
    "image": "any",
    "command": ["echo", "test"],
    "resourceRequirements": [{"type": "VCPU", "value": "0.25"}, {"type": "MEMORY", "value": "512"}],
    "executionRoleArn": "arn:aws:iam::123456789012:role/x",
}
MEMBERS: dict[str, Any] = {
    "fargatePlatformConfiguration": {"platformVersion": "1.4.0"},
    "networkConfiguration": {"assignPublicIp": "ENABLED"},
    "runtimePlatform": {"operatingSystemFamily": "LINUX", "cpuArchitecture": "ARM64"},
    "ephemeralStorage": {"sizeInGiB": 30},
}
EKS = {"podProperties": {"containers": [{"image": "any", "command": ["sleep", "60"]}]}}
NO_EC2 = "Job Queue is attached to Compute Environment that can not run Jobs with capability EC2."


def needs(cpus: str, memory: str, **more: str) -> dict[str, Any]:
    entries = {"VCPU": cpus, "MEMORY": memory, **more}
    return {"resourceRequirements": [{"type": kind, "value": value} for kind, value in entries.items()]}


def test_a_fargate_job_runs_and_is_shown_with_what_has_no_effect(batch: Batch) -> None:
    arn = batch.register("fargate", "container", containerProperties={**CONTAINER, **MEMBERS}, **FARGATE)
    [shown] = batch.api.describe_job_definitions(jobDefinitions=[arn])["jobDefinitions"]
    assert shown["platformCapabilities"] == ["FARGATE"]
    assert {key: shown["containerProperties"][key] for key in MEMBERS} == MEMBERS
    job = batch.submit(arn)
    detail = batch.wait(job)
    assert (detail["status"], batch.lines(job)) == ("SUCCEEDED", ["test"])
    assert detail["platformCapabilities"] == ["FARGATE"]
    assert {key: detail["container"][key] for key in MEMBERS} == MEMBERS
    noted = batch.server.client.get(f"/api/jobs/{job}")["withoutEffect"]
    assert noted == sorted([*MEMBERS, "platformCapabilities"])
    reported = batch.server.muster("show", job, MUSTER_URL=batch.server.url).stdout
    assert "no effect:" in reported and "networkConfiguration" in reported
    plain = batch.submit(batch.single("not-fargate", "true"))
    assert batch.server.client.get(f"/api/jobs/{plain}")["withoutEffect"] == []


def test_a_fargate_definition_without_a_platform_version_is_shown_with_the_latest(batch: Batch) -> None:
    arn = batch.register("fargate-latest", "container", containerProperties=CONTAINER, **FARGATE)
    [shown] = batch.api.describe_job_definitions(jobDefinitions=[arn])["jobDefinitions"]
    latest = {"platformVersion": "LATEST"}
    assert shown["containerProperties"]["fargatePlatformConfiguration"] == latest
    assert batch.describe(batch.submit(arn))["container"]["fargatePlatformConfiguration"] == latest


def test_the_members_of_a_fargate_task_run_and_are_shown(batch: Batch) -> None:
    only = {key: value for key, value in CONTAINER.items() if key != "executionRoleArn"}
    of_task = {
        **{key: value for key, value in MEMBERS.items() if key != "fargatePlatformConfiguration"},
        "platformVersion": "LATEST",
    }
    ecs = {"taskProperties": [{"containers": [{**only, "name": "main"}], **of_task}]}
    arn = batch.register("fargate-task", "container", ecsProperties=ecs, **FARGATE)
    job = batch.submit(arn)
    detail = batch.wait(job, "SUCCEEDED")
    [task] = detail["ecsProperties"]["taskProperties"]
    assert {key: task[key] for key in of_task} == of_task
    assert not set(of_task) & set(task["containers"][0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"privileged": True}, "privileged is not for Fargate"),
        ({"ulimits": [{"name": "nofile", "softLimit": 1, "hardLimit": 1}]}, "ulimits is not for Fargate"),
        ({"instanceType": "c5.large"}, "instanceType is not for Fargate"),
        ({"linuxParameters": {"sharedMemorySize": 64}}, "linuxParameters sharedMemorySize is not for Fargate"),
        ({"volumes": [{"name": "v", "host": {"sourcePath": "/x"}}]}, "volume 'v' of the host is not for Fargate"),
        ({"vcpus": 1, "memory": 2048, "resourceRequirements": []}, "vcpus is not for Fargate"),
        (needs("0.25", "512", GPU="1"), "Fargate has no GPUs"),
        (needs("3", "8192"), "no VCPU 3; it is 0.25, 0.5, 1, 2, 4, 8, 16, 32"),
        (needs("0.25", "4096"), "no MEMORY 4096 with VCPU 0.25; it is 512, 1024, 2048"),
        (needs("1", "2049"), "no MEMORY 2049 with VCPU 1; it is 2048 to 8192 in steps of 1024"),
        ({"ephemeralStorage": {"sizeInGiB": 20}}, "sizeInGiB is 20; it must be 21 to 200"),
        ({"runtimePlatform": {"operatingSystemFamily": "WINDOWS_SERVER_2022_CORE"}}, "nodes run LINUX"),
        ({"runtimePlatform": {"cpuArchitecture": "SPARC"}}, "cpuArchitecture is 'SPARC'; it is X86_64 or ARM64"),
        ({"networkConfiguration": {"assignPublicIp": "MAYBE"}}, "is 'MAYBE'; it is ENABLED or DISABLED"),
    ],
)
def test_what_fargate_does_not_have_is_refused_by_name(batch: Batch, change: dict[str, Any], message: str) -> None:
    with refused(message):
        batch.register("fargate-bad", "container", containerProperties={**CONTAINER, **change}, **FARGATE)


@pytest.mark.parametrize("member", ["fargatePlatformConfiguration", "networkConfiguration"])
def test_a_job_on_ec2_must_not_have_members_of_fargate(batch: Batch, member: str) -> None:
    with refused(f"{member} is for Fargate; add platformCapabilities FARGATE, or leave it out"):
        batch.register("ec2-bad", "container", containerProperties={**CONTAINER, member: MEMBERS[member]})


def test_empty_members_say_nothing(batch: Batch) -> None:
    empty = {"user": "", "linuxParameters": {"devices": [], "tmpfs": []}}
    batch.register("fargate-empty", "container", containerProperties={**CONTAINER, **empty}, **FARGATE)


def test_an_override_and_a_gang_can_t_leave_fargate(batch: Batch) -> None:
    arn = batch.register("fargate-override", "container", containerProperties=CONTAINER, **FARGATE)
    with refused("no MEMORY 64 with VCPU 0.25"):
        batch.submit(arn, containerOverrides=needs("0.25", "64"))
    nodes = {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": [{"targetNodes": "0:", "container": CONTAINER}]}
    with refused("Fargate runs no multi-node parallel jobs"):
        batch.register("fargate-gang", "multinode", nodeProperties=nodes, **FARGATE)
    with refused("platformCapabilities MANAGED_INSTANCES is not supported; use EC2 or FARGATE"):
        batch.register(
            "managed", "container", containerProperties=CONTAINER, platformCapabilities=["MANAGED_INSTANCES"]
        )


@pytest.mark.parametrize("kind", ["FARGATE", "FARGATE_SPOT"])
def test_a_fargate_compute_environment_runs_fargate_jobs_alone(batch: Batch, kind: str) -> None:
    name = f"ce-{kind.lower().replace('_', '-')}"
    resources = {"type": kind, "maxvCpus": 8, "subnets": ["subnet-none"], "securityGroupIds": ["sg-none"]}
    create = {"computeEnvironmentName": name, "type": "MANAGED"}
    for key, value in {"instanceTypes": ["optimal"], "minvCpus": 0, "allocationStrategy": "BEST_FIT"}.items():
        with refused(f"computeResources {key} is not for {kind}; leave it out"):
            batch.api.create_compute_environment(**create, computeResources={**resources, key: value})
    batch.api.create_compute_environment(**create, computeResources=resources)
    [shown] = batch.api.describe_compute_environments(computeEnvironments=[name])["computeEnvironments"]
    assert shown["computeResources"] == resources
    with refused("computeResources desiredvCpus is not for"):
        batch.api.update_compute_environment(computeEnvironment=name, computeResources={"desiredvCpus": 1})
    batch.queue(name, name)
    with refused("compute environments of EC2 and of Fargate can't be mixed"):
        order = [{"order": 1, "computeEnvironment": name}, {"order": 2, "computeEnvironment": "local"}]
        batch.api.update_job_queue(jobQueue=name, computeEnvironmentOrder=order)
    arn = batch.register("fargate-there", "container", containerProperties=CONTAINER, **FARGATE)
    batch.wait(batch.submit(arn, queue=name), "SUCCEEDED")
    for definition in (batch.single("ec2-there", "true"), batch.multinode("gang-there", "true")):
        with refused(NO_EC2, f"or use another queue than {name}"):
            batch.submit(definition, queue=name)
    batch.remove([name], [name])


@pytest.mark.parametrize(("kind", "own", "other"), [("FARGATE", "ECS_FARGATE", "ECS"), ("EC2", "ECS", "ECS_FARGATE")])
def test_the_type_of_a_queue_is_that_of_its_compute_environments(batch: Batch, kind: str, own: str, other: str) -> None:
    name = f"typed-{kind.lower()}"
    resources = {"type": kind, "maxvCpus": 8, "subnets": ["subnet-none"]}
    batch.api.create_compute_environment(computeEnvironmentName=name, type="MANAGED", computeResources=resources)
    for bad, message in [
        (other, f"jobQueueType is {other}, and the compute environments make it {own}"),
        ("EKS", "jobQueueType EKS is not supported: no engine is a Kubernetes cluster; use ECS or ECS_FARGATE"),
        ("EC2", "jobQueueType 'EC2' is not supported; use ECS or ECS_FARGATE"),
        ("SAGEMAKER_TRAINING", "jobQueueType 'SAGEMAKER_TRAINING' is not supported"),
    ]:
        with refused(message):
            batch.queue(name, name, jobQueueType=bad)
    batch.queue(name, name, jobQueueType=own)
    batch.queue(f"{name}-2", name)
    queues = batch.api.describe_job_queues(jobQueues=[name, f"{name}-2"])["jobQueues"]
    assert [queue["jobQueueType"] for queue in queues] == [own, own]
    batch.remove([name, f"{name}-2"], [name])


def test_a_compute_environment_of_a_queue_can_t_change_between_ec2_and_fargate(batch: Batch) -> None:
    resources = {"maxvCpus": 8, "subnets": ["subnet-none"]}
    names = {"EC2": "moves-ec2", "FARGATE": "moves-fargate"}
    for kind, name in names.items():
        create = {"computeEnvironmentName": name, "type": "MANAGED"}
        batch.api.create_compute_environment(**create, computeResources={"type": kind, **resources})
        batch.queue(name, name)

    def become(name: str, kind: str) -> None:
        batch.api.update_compute_environment(computeEnvironment=name, state="DISABLED", computeResources={"type": kind})

    for name, kind, queue in [("moves-ec2", "FARGATE_SPOT", "moves-ec2"), ("moves-fargate", "EC2", "moves-fargate")]:
        with refused(f"type {kind}: compute environment {name} is used by job queue {queue} and can't change between"):
            become(name, kind)
    with refused("type FARGATE: compute environment local is used by job queue default"):
        become("local", "FARGATE")
    listed = batch.api.describe_compute_environments(computeEnvironments=[*names.values(), "local"])
    shown = {each["computeEnvironmentName"]: each for each in listed["computeEnvironments"]}
    assert {name: each["computeResources"]["type"] for name, each in shown.items()} == {
        "local": "EC2",
        **{name: kind for kind, name in names.items()},
    }
    assert {each["state"] for each in shown.values()} == {"ENABLED"}, "a refused update changes nothing"
    become("moves-ec2", "SPOT")
    become("moves-fargate", "FARGATE_SPOT")
    batch.remove(list(names.values()), [])
    become("moves-ec2", "FARGATE")
    batch.remove([], list(names.values()))


KUBERNETES: list[tuple[dict[str, Any], str]] = [
    ({"ec2Configuration": [{"imageType": "EKS_AL2023"}]}, "ec2Configuration imageType EKS_AL2023"),
    ({"ec2Configuration": [{"imageType": "ECS_AL2", "imageKubernetesVersion": "1.30"}]}, "imageKubernetesVersion"),
    ({"launchTemplate": {"launchTemplateId": "x", "userdataType": "EKS_NODEADM"}}, "userdataType EKS_NODEADM"),
    (
        {"launchTemplate": {"launchTemplateId": "x", "overrides": [{"userdataType": "EKS_BOOTSTRAP_SH"}]}},
        "launchTemplate userdataType EKS_BOOTSTRAP_SH",
    ),
]


@pytest.mark.parametrize(("members", "name"), KUBERNETES)
def test_members_of_eks_are_refused_by_name_in_compute_resources(
    batch: Batch, members: dict[str, Any], name: str
) -> None:
    with refused(f"{name} is not supported: no engine is a Kubernetes cluster; leave it out"):
        batch.api.create_compute_environment(
            computeEnvironmentName="eks",
            type="MANAGED",
            computeResources={"type": "EC2", "maxvCpus": 1, "subnets": ["subnet-none"], **members},
        )
    with refused(f"{name} is not supported: no engine is a Kubernetes cluster; leave it out"):
        batch.api.update_compute_environment(computeEnvironment="local", computeResources=members)


def test_eks_is_refused_by_its_name_wherever_it_is_asked_for(batch: Batch) -> None:
    why = "eksProperties is not supported: no engine is a Kubernetes cluster; use"
    with refused(f"job definition eks: {why} containerProperties or ecsProperties"):
        batch.register("eks", "container", eksProperties=EKS)
    with refused(f"job definition eks: {why} nodeProperties"):
        batch.register("eks", "multinode", eksProperties=EKS)
    ranges = [{"targetNodes": "0:", "eksProperties": EKS}]
    with refused(f"node range 0:: {why} container or ecsProperties"):
        batch.register("eks", "multinode", nodeProperties={"numNodes": 1, "mainNode": 0, "nodeRangeProperties": ranges})
    with refused("eksConfiguration is not supported: no engine is a Kubernetes cluster"):
        batch.api.create_compute_environment(
            computeEnvironmentName="eks",
            type="MANAGED",
            eksConfiguration={"eksClusterArn": f"{PREFIX}cluster/x", "kubernetesNamespace": "x"},
            computeResources={"type": "EC2", "maxvCpus": 1, "subnets": ["subnet-none"]},
        )
    with refused("eksConfiguration is not supported: no engine is a Kubernetes cluster; leave it out"):
        batch.api.update_compute_environment(
            computeEnvironment="local", eksConfiguration={"accessEntry": {"desiredState": "ENABLED"}}
        )
