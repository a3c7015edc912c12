"""``muster submit --dry-run``: what would start where, and nothing starts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from orchestrator.client import ApiError
from tests.conftest import Serving, run_muster

SPEC = "job_specs/cartpole.yaml"


def test_a_plan_shows_every_node_and_nothing_is_registered_or_started(server: Serving, tmp_path: Path) -> None:
    shown = server.muster("submit", SPEC, "--dry-run", "--set", "resources.cpus=0.1")
    assert shown.returncode == 0, shown.stderr
    lines = shown.stdout.splitlines()
    assert lines[0] == "cartpole on the local engine, queue default; nothing was started"
    assert len(lines) == 5 and all("python -P -m worker.train" in line for line in lines[2:])
    plan = json.loads(server.muster("submit", SPEC, "--dry-run", "--json", "--set", "resources.cpus=0.1").stdout)
    assert [node["rank"] for node in plan["nodes"]] == [0, 1, 2]
    told = plan["nodes"][1]["environment"]
    assert told["MASTER_ADDR"] == plan["nodes"][0]["address"] != plan["nodes"][1]["address"]
    assert (told["AWS_BATCH_JOB_NODE_INDEX"], told["NNODES"]) == ("1", "3")
    assert plan["registerJobDefinition"]["nodeProperties"]["numNodes"] == 3
    assert server.client.batch("DescribeJobDefinitions")["jobDefinitions"] == []
    assert server.client.batch("ListJobs", jobQueue="default")["jobSummaryList"] == []


def test_the_whole_command_is_there_however_narrow_the_terminal(server: Serving) -> None:
    whole = "python -P my_train.py " + " ".join(f"--option-{number}=value" for number in range(12))
    (server.home / "job.yaml").write_text(
        f"name: long\nresources: {{cpus: 0.1}}\ncommand: [{whole.replace(' ', ', ')}]\n"
    )
    narrow = run_muster("submit", str(server.home / "job.yaml"), "--dry-run", home=server.home, COLUMNS="80")
    assert narrow.stdout.splitlines()[2].rstrip().endswith(whole), narrow.stdout


def test_a_plan_is_made_of_what_a_submission_would_be_given(server: Serving) -> None:
    """With where the bus of the controller is, but not its password."""
    seen = server.home / "seen"
    script = f"import json, os; json.dump(dict(os.environ), open('{seen}', 'w'))"
    (server.home / "job.yaml").write_text(
        json.dumps({"name": "same", "priority": 7, "resources": {"cpus": 0.1}, "command": ["python", "-c", script]})
    )
    [node] = json.loads(server.muster("submit", str(server.home / "job.yaml"), "--dry-run", "--json").stdout)["nodes"]
    job = json.loads(server.muster("submit", str(server.home / "job.yaml"), "--json").stdout)["jobId"]
    assert server.wait(job)["status"] == "SUCCEEDED"
    found, own = json.loads(seen.read_text()), {"MASTER_PORT", "MUSTER_ADDRESS", "MASTER_ADDR", "MUSTER_GANG"}
    planned = {name: value for name, value in node["environment"].items() if name not in own}
    differing = {name: value for name, value in planned.items() if found.get(name) != value}
    assert differing.pop("MUSTER_BUS_TOKEN") == "…" and planned["MUSTER_BUS"] == found["MUSTER_BUS"]
    assert differing.pop("MUSTER_RUN") == "run"
    assert all(value.partition("#")[0] == "job" for value in differing.values()), differing


def test_a_job_that_fits_nowhere_has_no_plan(server: Serving) -> None:
    refused = server.muster("submit", SPEC, "--dry-run", "--set", "resources.cpus=900")
    assert refused.returncode == 2 and refused.stderr.count("\n") == 1
    assert "each node needs 900 CPUs" in refused.stderr


@pytest.mark.parametrize(
    "definition",
    [{}, {"jobDefinitionName": "a", "type": "container"}, {"jobDefinitionName": "a", "type": "multinode"}, {"type": 3}],
)
def test_what_is_no_gang_is_refused(server: Serving, definition: dict) -> None:
    with pytest.raises(ApiError) as refusal:
        server.client.post("/api/plan", {"definition": definition})
    assert refusal.value.status == 400 and "\n" not in str(refusal.value)


def test_an_image_that_would_not_be_run_is_passed_over_or_refused_as_the_compute_environment_says(
    server: Serving,
) -> None:
    batch = server.client.batch
    tags = {"muster:images": "refuse"}
    batch("CreateComputeEnvironment", computeEnvironmentName="strict", type="UNMANAGED", tags=tags)
    order = [{"order": 1, "computeEnvironment": "strict"}]
    batch("CreateJobQueue", jobQueueName="strict", priority=1, computeEnvironmentOrder=order)
    container = {"image": "busybox", "command": ["true"]}
    container["resourceRequirements"] = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}]
    properties = {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": [{"targetNodes": "0:", "container": container}]}
    definition = {"jobDefinitionName": "foreign", "type": "multinode", "nodeProperties": properties}
    assert not server.client.post("/api/plan", {"definition": definition})["images"]
    with pytest.raises(ApiError, match="image busybox: the local engine runs commands in its nodes' own environment"):
        server.client.post("/api/plan", {"definition": definition, "queue": "strict"})
    batch("RegisterJobDefinition", **definition)
    passed = batch("SubmitJob", jobName="a", jobQueue="default", jobDefinition="foreign")["jobId"]
    refused = batch("SubmitJob", jobName="b", jobQueue="strict", jobDefinition="foreign")["jobId"]
    assert server.wait(passed)["status"] == "SUCCEEDED"
    assert "image busybox: the local engine" in server.wait(refused)["statusReason"]
