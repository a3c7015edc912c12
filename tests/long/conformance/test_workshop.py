"""The Isaac Lab workshop's flow (reference §7.3) with nothing but ``aws --endpoint-url``: a real training, its volume, its logs.

Between any two calls the server is killed and started again on the same home and port: nothing changes for the client.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.conformance.aws import PREFIX, aws, pairs

EFS = "/efs-muster-test"
"""Where the job sees the shared volume; on this machine an empty directory that only the job's processes see filled."""

COMMAND = r"""
mkdir -p "$EFS/models" && echo "node $AWS_BATCH_JOB_NODE_INDEX of $AWS_BATCH_JOB_NUM_NODES: $TASK, $MAX_ITERATIONS";
export MUSTER_SPEC=$(sed -E "s/(\"task\":)\"\w+\"/\1\"$TASK\"/; s/(\"iterations\":)[0-9]+/\1$MAX_ITERATIONS/" <<< "$MUSTER_SPEC");
python -P -m worker.train || exit 1;
if [ -z "$AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS" ]; then
cp "$EFS/runs/$MUSTER_RUN/run.json" "$EFS/models/"; cd "$EFS" && find runs/*/checkpoints runs/*/logs models | sed 's/^/found /'; fi
""".strip().replace("\n", " ")
"""A one-liner in the style of the workshop's: the task and its length come from the environment, the work goes to the volume."""


class Restarting(Serving):
    """A server that :meth:`crash` kills and starts again where it was."""

    def crash(self) -> None:
        url = self.url
        self.kill()
        self.options = ("--port", url.rpartition(":")[2], *self.options[-2:])
        self.start()
        assert self.url == url


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Restarting]:
    server = Restarting(tmp_path / "home", "--cpus", "4")
    yield server
    server.close()
    if os.path.isdir(EFS):
        os.rmdir(EFS)


def node_properties() -> dict[str, Any]:
    """The workshop's, on two small nodes; the training is the one that ``job_specs/cartpole.yaml`` compiles to, made smaller."""
    small = ["nodes=2", "train.worlds=8", "train.iterations=100", "checkpoint.every=2"]
    compiled = compile_definition(specfile.load("job_specs/cartpole.yaml", small), "/")
    container = compiled["nodeProperties"]["nodeRangeProperties"][0]["container"]
    ours = {each["name"]: each["value"] for each in container["environment"]}
    environment = {
        "TASK": "Ant",
        "MAX_ITERATIONS": "100",
        "NCCL_SOCKET_IFNAME": "eth0",
        "ACCEPT_EULA": "Y",
        "PRIVACY_CONSENT": "Y",
        "PROC_PER_NODE": "1",
        "EFS": EFS,
        "MUSTER_SPEC": ours["MUSTER_SPEC"],
        "MUSTER_RANKS_PER_NODE": ours["MUSTER_RANKS_PER_NODE"],
    }
    container = {
        "image": "muster",
        "command": ["bash", "-c", COMMAND],
        "environment": pairs(environment),
        "resourceRequirements": [{"type": "VCPU", "value": "1"}, {"type": "MEMORY", "value": "1024"}],
        "linuxParameters": {"sharedMemorySize": 60000},
        "volumes": [{"name": "efs", "efsVolumeConfiguration": {"fileSystemId": "fs-12345", "rootDirectory": "/"}}],
        "mountPoints": [{"sourceVolume": "efs", "containerPath": EFS, "readOnly": False}],
    }
    ranges = [{"targetNodes": "0:1", "container": container}]
    return {"numNodes": 2, "mainNode": 0, "nodeRangeProperties": ranges}


@pytest.mark.skipif(
    os.geteuid() != 0, reason="NOT TESTED: the workshop's EFS volume is a mount, and mounting needs root"
)
def test_the_workshop_from_its_compute_environment_to_its_logs_while_the_server_crashes(server: Restarting) -> None:
    def now(*arguments: str) -> dict[str, Any]:
        answer: dict[str, Any] = aws(server.url, *arguments)
        return answer

    def call(*arguments: str) -> dict[str, Any]:
        """The next call of the flow, after a crash."""
        server.crash()
        return now(*arguments)

    created = now(
        *("batch", "create-compute-environment", "--type", "MANAGED", "--state", "ENABLED"),
        *("--compute-environment-name", "IsaacLabComputeResource", "--compute-resources"),
        "type=EC2,allocationStrategy=BEST_FIT_PROGRESSIVE,minvCpus=0,maxvCpus=256,instanceTypes=g6.12xlarge,"
        "subnets=subnet-12345,securityGroupIds=sg-12345,instanceRole=ecsInstanceRole,"
        "launchTemplate={launchTemplateName=IsaacLabLaunchTemplate}",
    )
    assert created["computeEnvironmentArn"] == f"{PREFIX}compute-environment/IsaacLabComputeResource"
    call(
        *("batch", "create-job-queue", "--job-queue-name", "IsaacLabJobQueue", "--priority", "1"),
        *("--compute-environment-order", "order=1,computeEnvironment=IsaacLabComputeResource"),
    )
    [queue] = call("batch", "describe-job-queues", "--job-queues", "IsaacLabJobQueue")["jobQueues"]
    assert (queue["status"], queue["state"]) == ("VALID", "ENABLED")
    registered = call(
        *("batch", "register-job-definition", "--job-definition-name", "IsaacLabJobDefinition", "--type", "multinode"),
        *("--timeout", "attemptDurationSeconds=3600", "--node-properties", json.dumps(node_properties())),
    )
    assert registered["revision"] == 1
    override = {"environment": pairs({"TASK": "Cartpole", "MAX_ITERATIONS": "4"})}
    overrides = {"nodePropertyOverrides": [{"targetNodes": "0:1", "containerOverrides": override}]}
    job = call(
        *("batch", "submit-job", "--job-name", "isaac-lab", "--job-queue", "IsaacLabJobQueue"),
        *("--job-definition", "IsaacLabJobDefinition", "--node-overrides", json.dumps(overrides)),
    )["jobId"]

    # the server crashes before each of these looks: while the gang starts, and while it runs
    call("batch", "describe-jobs", "--jobs", job)
    server.wait(job, "RUNNING")
    for _ in range(2):
        call("batch", "describe-jobs", "--jobs", job)
    server.wait(job, timeout=240)
    [ended] = now("batch", "describe-jobs", "--jobs", job)["jobs"]
    parent, main, child = call("batch", "describe-jobs", "--jobs", job, f"{job}#0", f"{job}#1")["jobs"]
    assert parent == ended, "a crash changes no answer"
    logs = []
    for each in (main, child):
        stream = each["container"]["logStreamName"]
        page = call("logs", "get-log-events", "--log-group-name", "/aws/batch/job", "--log-stream-name", stream)
        logs.append([event["message"] for event in page["events"]])
    assert parent["status"] == "SUCCEEDED", logs
    assert len(parent["attempts"]) == 1, "no crash of the server cost the job anything"
    assert "container" not in parent and parent["timeout"] == {"attemptDurationSeconds": 3600}
    for node in range(2):
        assert f"node {node} of 2: Cartpole, 4" in logs[node]
    _check_volume(server, logs[0], job)


def _check_volume(server: Restarting, log: list[str], job: str) -> None:
    """What the job saw on its volume is what lies on the store, and is nowhere else."""
    seen = {line.removeprefix("found ") for line in log if line.startswith("found ")}
    [run] = Store(server.home / "store").runs()
    checkpoints = list_checkpoints(run)
    assert [checkpoint.iteration for checkpoint in checkpoints] == [2, 4]
    assert {f"runs/{run.name}/checkpoints/{checkpoint.path.name}" for checkpoint in checkpoints} <= seen
    assert {f"runs/{run.name}/logs/{job}/1/node-{node}.log" for node in range(2)} <= seen
    assert "models/run.json" in seen and (server.home / "store" / "models" / "run.json").exists()
    assert os.listdir(EFS) == [], "others do not see what is mounted for the job"
