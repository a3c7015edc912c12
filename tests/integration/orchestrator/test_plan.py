"""``muster submit --dry-run``: what would start where, and nothing starts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from orchestrator.cli.submitting import submit_spec
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError, SpecError
from orchestrator.engines.api import Gang, Plan
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.server import Server
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from shared_store.volume.files import write_json
from tests.conftest import Serving, wait_for
from tests.support.definitions import container, multinode, submission_of
from tests.support.orchestrator.jobs import jobs_of, serving

SPEC = "job_specs/cartpole.yaml"


def test_a_plan_shows_every_node_and_nothing_is_registered_or_started(shared_server: Serving) -> None:
    before = jobs_of(shared_server.client)
    shown = shared_server.muster("submit", SPEC, "--dry-run", "--set", "resources.cpus=0.1")
    assert shown.returncode == 0, shown.stderr
    lines = shown.stdout.splitlines()
    assert lines[0] == "cartpole on the local engine, queue default; nothing was started"
    assert len(lines) == 5 and all("python -P -m worker.train" in line for line in lines[2:])
    plan = json.loads(shared_server.muster("submit", SPEC, "--dry-run", "--json", "--set", "resources.cpus=0.1").stdout)
    assert [node["rank"] for node in plan["nodes"]] == [0, 1, 2]
    reported = plan["nodes"][1]["environment"]
    assert reported["MASTER_ADDR"] == plan["nodes"][0]["address"] != plan["nodes"][1]["address"]
    assert (reported["AWS_BATCH_JOB_NODE_INDEX"], reported["NNODES"]) == ("1", "3")
    assert plan["registerJobDefinition"]["nodeProperties"]["numNodes"] == 3
    named = plan["registerJobDefinition"]["jobDefinitionName"]
    assert shared_server.client.batch("DescribeJobDefinitions", jobDefinitionName=named)["jobDefinitions"] == []
    assert jobs_of(shared_server.client) == before


def test_the_whole_command_is_printed_on_any_width_of_terminal(shared_server: Serving, tmp_path: Path) -> None:
    whole = "python -P my_train.py " + " ".join(f"--option-{number}=value" for number in range(12))
    spec = tmp_path / "job.yaml"
    spec.write_text(f"name: long\nresources: {{cpus: 0.1}}\ncommand: [{whole.replace(' ', ', ')}]\n")
    narrow = shared_server.muster("submit", str(spec), "--dry-run", COLUMNS="80")
    assert narrow.stdout.splitlines()[2].rstrip().endswith(whole), narrow.stdout


def test_a_plan_has_the_same_input_as_a_submission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, supplied = LocalEngine.plan, []

    def noted(engine: LocalEngine, gang: Gang) -> Plan[Any]:
        supplied.append(gang)
        return plan(engine, gang)

    monkeypatch.setattr(LocalEngine, "plan", noted)
    train = {"task": "Cartpole", "worlds": 4, "iterations": 1}
    spec = validate({"name": "same", "priority": 7, "timeout": "1h", "stall_timeout": "3m", "train": train}, "test")
    with serving(tmp_path) as client:
        client.post("/api/plan", {"definition": compile_definition(spec, "/nowhere")})
        client.batch("RegisterJobDefinition", **compile_definition(spec, "/nowhere"))
        client.batch("SubmitJob", **submission_of(spec, "same"))
        wait_for(lambda: len(supplied) == 2, 30, "the launch")
    planned, submitted = supplied
    assert (planned.priority, planned.stall_timeout, planned.timeout) == (7, 180.0, 3600)
    assert planned.bus == submitted.bus and planned.bus_token == "…", "the password is not for who only looks"
    own = ("job", "run", "bus_token")
    assert planned == replace(submitted, **{name: getattr(planned, name) for name in own})


@pytest.mark.parametrize(
    "definition",
    [{}, {"jobDefinitionName": "a", "type": "container"}, {"jobDefinitionName": "a", "type": "multinode"}, {"type": 3}],
)
def test_properties_that_describe_no_gang_are_refused(shared_server: Serving, definition: dict) -> None:
    with pytest.raises(ApiError) as refusal:
        shared_server.client.post("/api/plan", {"definition": definition})
    assert refusal.value.status == 400 and "\n" not in str(refusal.value)


def test_an_image_that_would_not_run_is_refused_where_the_compute_environment_says(shared_server: Serving) -> None:
    batch = shared_server.client.batch
    tags = {"muster:images": "refuse"}
    batch("CreateComputeEnvironment", computeEnvironmentName="strict", type="UNMANAGED", tags=tags)
    order = [{"order": 1, "computeEnvironment": "strict"}]
    batch("CreateJobQueue", jobQueueName="strict", priority=1, computeEnvironmentOrder=order)
    definition = multinode("foreign", container(image="busybox"))
    assert not shared_server.client.post("/api/plan", {"definition": definition})["images"]
    with pytest.raises(ApiError, match="image busybox: the local engine runs commands in its nodes' own environment"):
        shared_server.client.post("/api/plan", {"definition": definition, "queue": "strict"})
    batch("RegisterJobDefinition", **definition)
    passed = batch("SubmitJob", jobName="a", jobQueue="default", jobDefinition="foreign")["jobId"]
    refused = batch("SubmitJob", jobName="b", jobQueue="strict", jobDefinition="foreign")["jobId"]
    assert shared_server.wait(passed)["status"] == "SUCCEEDED"
    assert "image busybox: the local engine" in shared_server.wait(refused)["statusReason"]


def test_a_plan_a_submission_and_a_resume_place_a_job_as_its_compute_environment_allows(inside: Server) -> None:
    resources = {"type": "EC2", "maxvCpus": 1, "subnets": ["none"]}
    environments: dict[str, dict[str, Any]] = {"small": {"type": "MANAGED", "computeResources": resources}}
    environments["elsewhere"] = {"type": "UNMANAGED", "tags": {"muster:hosts": "another"}}
    train = {"task": "Cartpole", "worlds": 6, "iterations": 2}
    document = {"name": "fits", "nodes": 3, "resources": {"cpus": 0.4, "memory": 16}, "train": train}
    refusals = {
        "small": "compute environment small has at most 1 CPU; needs 3 nodes with 1.2 CPUs, 0 GPUs, 48 MiB in all",
        "elsewhere": "the largest host has nothing: there is no host",
        "nowhere": "Job queue nowhere does not exist; available: default, elsewhere",
    }
    with Client(inside.url) as client:
        for name, facts in environments.items():
            client.batch("CreateComputeEnvironment", computeEnvironmentName=name, **facts)
            order = [{"order": 1, "computeEnvironment": name}]
            client.batch("CreateJobQueue", jobQueueName=name, priority=1, computeEnvironmentOrder=order)
        for name, output in refusals.items():
            spec = validate({**document, "queue": name}, "job.yaml")
            run = {"run": f"fits-{name}", "spec": {**document, "queue": name}}
            write_json(inside.store.run(f"fits-{name}").path / "run.json", run)
            with pytest.raises((SpecError, ApiError)) as submitted:
                submit_spec(client, spec, "job.yaml")
            with pytest.raises(ApiError) as planned:
                client.post("/api/plan", {"definition": compile_definition(spec, "/"), "queue": name})
            assert output in str(submitted.value) and output in str(planned.value)
            with pytest.raises(ApiError) as resumed:
                client.post(f"/api/runs/fits-{name}/resume", {})
            assert output in str(resumed.value) or "Job queue nowhere does not exist" in str(resumed.value)
        assert client.batch("DescribeJobDefinitions", jobDefinitionName="fits")["jobDefinitions"] == []
        elastic = compile_definition(validate({**document, "nodes": {"min": 1, "max": 3}}, "job.yaml"), "/")
        plan = client.post("/api/plan", {"definition": elastic, "queue": "small"})
    assert (plan["computeEnvironment"], len(plan["nodes"])) == ("small", 2), "as many nodes as 1 CPU has room for"


def test_an_option_of_an_engine_that_is_misspelt_is_refused_when_the_tag_is_made(inside: Server) -> None:
    def refused(operation: str, **request: Any) -> str:
        with pytest.raises(ApiError) as refusal:
            client.batch(operation, **request)
        assert refusal.value.status == 400
        return str(refusal.value)

    arn = "arn:aws:batch:us-east-1:000000000000:"
    with Client(inside.url) as client:
        tags = {"muster:engine": "slurm", "muster:partiton": "gpu"}
        slurm = {"computeEnvironmentName": "cluster", "type": "UNMANAGED"}
        output = refused("CreateComputeEnvironment", **slurm, tags=tags)
        assert "muster:partiton: a compute environment of the slurm engine has no such option" in output
        assert "; did you mean part" in output
        output = refused("CreateComputeEnvironment", **slurm, tags={"muster:engine": "slrum"})
        assert "no such engine; did you mean slurm?" in output
        client.batch("CreateComputeEnvironment", **slurm, tags={"muster:engine": "slurm", "muster:partition": "gpu"})
        tagged = refused("TagResource", resourceArn=f"{arn}compute-environment/cluster", tags={"muster:nice": "low"})
        assert "tag muster:nice is 'low', not an integer" in tagged
        night = {"jobQueueName": "night", "priority": 1}
        night["computeEnvironmentOrder"] = [{"order": 1, "computeEnvironment": "cluster"}]
        assert "did you mean qos?" in refused("CreateJobQueue", **night, tags={"muster:qs": "low"})
        assert "no such option" in refused("CreateJobQueue", **night, tags={"muster:hosts": "a"})
        client.batch("CreateJobQueue", **night, tags={"muster:qos": "low", "muster:images": "refuse", "owner": "me"})
        queue = f"{arn}job-queue/night"
        assert "did you mean time?" in refused("TagResource", resourceArn=queue, tags={"muster:tme": "8:00:00"})
        client.batch("TagResource", resourceArn=queue, tags={"muster:time": "8:00:00"})
        kept = {"muster:qos": "low", "muster:images": "refuse", "owner": "me", "muster:time": "8:00:00"}
        assert client.batch("ListTagsForResource", resourceArn=queue)["tags"] == kept
