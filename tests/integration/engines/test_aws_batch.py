"""The aws-batch engine on a second Muster, which plays AWS: boto3 reaches it as it would reach AWS itself.

The controller and its store are one home directory, "AWS" and the volume of its nodes are another.
"""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import boto3
import pytest

from orchestrator.domain.hosts import Limit, Placement
from orchestrator.engines.api import EngineError, Gang, NotYet, Transient
from orchestrator.engines.aws_batch import engine as aws_batch
from orchestrator.engines.aws_batch.config import AwsConfig, is_mounted_from, save_config
from orchestrator.engines.aws_batch.engine import AwsBatchEngine
from orchestrator.engines.toolkit.statuses import status_of
from shared_store.volume.epoch import Claim, raise_epoch, read_epoch
from shared_store.volume.layout import Store
from tests.conftest import Serving, call_muster, wait_for
from tests.support.engines.bench import Bench
from tests.support.engines.sites import WAIT
from tests.support.processes import command, processes_of


class AwsBench(Bench):
    """A controller's home and store, the volume that the nodes have, and the engine between them."""

    engine: AwsBatchEngine
    asks_again = ("AWS Batch",)

    def __init__(self, aws: Serving, home: Path, **config: Any) -> None:
        self.aws = aws
        self.volume = Store(home / "efs").open()
        settings = {"store": str(self.volume.path), "poll": 0.1, "quiet": 1.0, **config}
        reported = {
            "region": "us-east-1",
            "job_queue": "default",
            "image": "muster",
            "endpoint_url": aws.url,
            **settings,
        }
        save_config(home, AwsConfig(**reported))
        super().__init__(home, self.volume if config.get("store_is_shared") else None)

    def new_engine(self) -> AwsBatchEngine:
        return AwsBatchEngine(self.home)

    def gang(
        self, script: str = WAIT, nodes: int = 2, *, suffix: str = "", native: bool = True, **changes: Any
    ) -> Gang:
        """``native``: with Muster in the image."""
        environment = {"GREETING": "hello", **({"MUSTER_ON_CHILD_FAILURE": "restart"} if native else {})}
        facts = {
            "environments": [environment] * nodes,
            "placements": [Placement("aws-batch/default", (), 0.5, 64)] * nodes,
            "directory": "/no/such/directory",
            "is_native": native,
            "containers": [{"image": "muster" if native else "busybox"}] * nodes,
            "title": self.home.name.replace("_", "-"),
        }
        return super().gang(script, nodes, suffix=suffix, **{**facts, **changes})

    def processes(self) -> list[int]:
        """Of all nodes: those that "AWS" runs, and those that see the volume."""
        return [*processes_of(self.aws.home), *processes_of(self.volume.path)]


LAST = (
    '[ $RANK != 0 ] || until [ "$(ls $MUSTER_STORE/runs/run/outcomes/$MUSTER_JOB_ID/1 2>/dev/null | wc -l)" = $((WORLD_SIZE - 1)) ]; '
    "do sleep 0.05; done"
)
"""Shell: the main node, whose end ends the others wherever they are, waits until they have ended by themselves."""


@pytest.fixture(scope="module")
def aws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """The second Muster."""
    with Serving(tmp_path_factory.mktemp("aws"), "--cpus", "16") as serving, pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "any")
        yield serving


@pytest.fixture
def bench(aws: Serving, tmp_path: Path) -> Iterator[AwsBench]:
    found = AwsBench(aws, tmp_path)
    yield found
    found.close()


@pytest.fixture
def workstation(aws: Serving, tmp_path: Path) -> Iterator[AwsBench]:
    """A controller whose store is the volume itself."""
    found = AwsBench(aws, tmp_path, store_is_shared=True)
    yield found
    found.close()


def test_the_requests_carry_image_volume_shared_memory_and_logs(aws: Serving, tmp_path: Path) -> None:
    bench = AwsBench(aws, tmp_path, image="1.dkr.ecr/muster:2", file_system="fs-1", access_point="fsap-1", efa=True)
    gang = bench.gang(nodes=3, timeout=100, placements=[Placement("h", ("0", "1"), 3.5, 4096)] * 3)
    plan = bench.engine.plan(gang)
    document = json.loads(plan.document)
    definition, submission = document["RegisterJobDefinition"], document["SubmitJob"]
    [entry] = definition["nodeProperties"]["nodeRangeProperties"]
    container = entry["container"]
    assert (entry["targetNodes"], container["image"]) == ("0:2", "1.dkr.ecr/muster:2")
    assert container["command"] == ["python", "-P", "-m", "worker.aws_node", "--", "sh", "-c", WAIT]
    amounts = {each["type"]: each["value"] for each in container["resourceRequirements"]}
    assert amounts == {"VCPU": "4", "MEMORY": "4096", "GPU": "2"}, "AWS takes whole vCPUs only"
    assert container["linuxParameters"]["sharedMemorySize"] == 2048
    assert container["linuxParameters"]["devices"][0]["hostPath"] == "/dev/infiniband/uverbs0"
    access = {"accessPointId": "fsap-1", "iam": "ENABLED"}
    volume = {"fileSystemId": "fs-1", "transitEncryption": "ENABLED", "authorizationConfig": access}
    assert container["volumes"][0]["efsVolumeConfiguration"] == volume
    assert container["mountPoints"][0]["containerPath"] == str(bench.volume.path)
    assert container["logConfiguration"]["options"] == {"awslogs-group": "/aws/batch/job"}
    assert definition["retryStrategy"] == {"attempts": 1} and submission["timeout"] == {"attemptDurationSeconds": 700}
    names = {each["name"] for each in container["environment"]}
    assert not any(name.startswith("AWS_BATCH") for name in names), "reserved on AWS"
    again = json.loads(bench.engine.plan(bench.gang(nodes=3, attempt=2, placements=gang.placements)).document)
    assert again["RegisterJobDefinition"] == definition, "one definition for all attempts"
    tagged = bench.gang(nodes=1, options={"job-queue": "night", "image": "other:1", "share": "alice"}, priority=7)
    changed = json.loads(bench.engine.plan(tagged).document)["SubmitJob"]
    found = [changed[name] for name in ("jobQueue", "shareIdentifier", "schedulingPriorityOverride")]
    assert found == ["night", "alice", 7]


def test_aws_gets_the_request_of_the_plan(bench: AwsBench) -> None:
    sent: dict[str, dict[str, Any]] = {}
    for client, name in ((bench.engine._batch, "RegisterJobDefinition"), (bench.engine._submitting, "SubmitJob")):
        note = lambda params, name=name, **_: sent.update({name: params})  # noqa: E731
        client.meta.events.register(f"provide-client-params.batch.{name}", note)
    gang = bench.gang(nodes=2, timeout=100)
    plan = bench.engine.plan(gang)
    bench.launch(gang)
    assert sent["RegisterJobDefinition"] == plan.request.definition
    arn = sent["SubmitJob"].pop("jobDefinition")
    assert sent["SubmitJob"] == plan.request.submission and plan.request.definition["jobDefinitionName"] in arn
    shown = json.loads(plan.document)
    assert shown["RegisterJobDefinition"] == plan.request.definition
    assert shown["SubmitJob"].items() >= plan.request.submission.items()


def test_nodes_of_different_kinds_are_ranges_of_their_own(bench: AwsBench) -> None:
    kinds = [["sh", "-c", f"echo kind {kind}"] for kind in (0, 0, 1)]
    handle = bench.launch(bench.gang(nodes=3, commands=kinds, environments=[{"MUSTER_ON_CHILD_FAILURE": "ignore"}] * 3))
    bench.ended(handle)
    assert [line for line in bench.log() if line == "kind 0"] and bench.outcome(0).exit_code == 0
    many = [["echo", str(kind)] for kind in range(6)]
    with pytest.raises(EngineError, match="of 6 kinds; AWS Batch takes at most 5"):
        bench.engine.plan(bench.gang(nodes=6, commands=many))


def test_a_job_that_a_dead_controller_submitted_is_found(bench: AwsBench) -> None:
    gang = bench.gang()
    handle = bench.launch(gang)
    successor = AwsBatchEngine(bench.home)
    assert successor.launch(successor.plan(gang)) == handle, "found, not started twice"
    bench.ready(gang)
    assert len(bench.processes()) == len({*bench.processes()}) and len(processes_of(bench.volume.path)) == 2
    bench.engine.stop(handle, 1.0)
    second = bench.gang("exit 0", attempt=2)
    assert bench.launch(second).facts["aws"] != handle.facts["aws"]
    definitions = bench.aws.client.batch("DescribeJobDefinitions", jobDefinitionName=f"muster-{gang.title}")
    assert len(definitions["jobDefinitions"]) == 2, "another command is another revision"


@pytest.mark.parametrize("store", ["bench", "workstation"])
def test_a_child_whose_supervisor_is_killed_ends_the_gang(request: pytest.FixtureRequest, store: str) -> None:
    """AWS itself would let it run for ever; no controller looks meanwhile."""
    bench = request.getfixturevalue(store)
    handle = bench.ready(bench.gang(nodes=3))
    os.kill(_supervisor(bench, 2), signal.SIGKILL)
    wait_for(lambda: bench.processes() == [], 30, "the end of all nodes without a controller")
    status = bench.ended(handle)
    assert all(node.exit_code for node in status), status
    assert bench.outcome(0).reason == "node 2 vanished: its supervisor or its host died"
    assert bench.outcome(0).exit_code == 143 and bench.log().count("ready") == 3


def test_a_child_that_fails_ends_the_gang_with_its_reason_and_one_that_is_done_does_not(bench: AwsBench) -> None:
    failing = "echo ready; case $NODE_RANK in 0) exec sleep 600;; 1) exit 0;; 2) sleep 1; exit 3;; esac"
    bench.ended(bench.launch(bench.gang(failing, 3)))
    assert bench.outcome(0).reason == "node 2: rank 2 exited with code 3"
    assert bench.outcome(2).exit_code == 3 and bench.outcome(1).exit_code == 0


def test_an_image_without_muster_runs_as_it_is(bench: AwsBench) -> None:
    handle = bench.launch(bench.gang("echo plain $GREETING $AWS_BATCH_JOB_NODE_INDEX; exit 4", 1, native=False))
    [node] = bench.ended(handle)
    assert node.exit_code == 4
    wait_for(lambda: "plain hello 0" in bench.log(), 10, "its log")
    assert bench.outcome(0).exit_code == 4


@pytest.mark.parametrize("options", [{"awslogs-group": "/fleet/robots"}, {"awslogs-stream-prefix": "fleet"}, None])
def test_the_log_of_a_node_is_read_from_its_own_log_group(
    aws: Serving, tmp_path: Path, options: dict[str, str] | None
) -> None:
    """AWS's own group holds the log of a container whose options name none; the stack's group, that of one without options."""
    bench = AwsBench(aws, tmp_path, log_group="/of/the/stack")
    log = {"logConfiguration": {"logDriver": "awslogs", "options": options}} if options else {}
    handle = bench.launch(
        bench.gang(
            "echo mine", 1, native=False, containers=[{"image": "busybox", **log}], title=f"g{len(str(options))}"
        )
    )
    bench.ended(handle)
    wait_for(lambda: "mine" in bench.log(), 10, "its log")
    bench.close()


def test_gangs_that_come_and_go_double_no_line_of_another(bench: AwsBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aws_batch, "_REMEMBERED", 1)
    script = "for i in $(seq 100); do echo tick $i; sleep 0.1; done"
    running = bench.launch(bench.gang(script, 1, native=False))
    wait_for(lambda: status_of(bench.engine, running) and "tick 1" in bench.log(), 20, "its first line")
    for attempt in (2, 3):
        short = bench.launch(bench.gang("true", 1, native=False, attempt=attempt))
        bench.ended(short)
        bench.engine.stop(short, 1.0)
    bench.ended(running)
    bench.engine.stop(running, 1.0)
    ticks = [line for line in bench.log() if line.startswith("tick")]
    assert ticks == [f"tick {i}" for i in range(1, 101)]
    assert [node.exit_code for node in bench.ended(running)] == [0], "it is remembered, or asked for anew"
    assert bench.log().count("tick 100") == 1


def test_on_the_volume_itself_the_supervisors_write_and_nothing_is_copied(workstation: AwsBench) -> None:
    handle = workstation.launch(workstation.gang(f"echo rank $RANK; {LAST}; exit $RANK", 2))
    assert [node.exit_code for node in workstation.ended(handle)][1] == 1
    assert sorted(workstation.log())[:2] == ["rank 0", "rank 1"] and len(workstation.log()) == 2
    assert workstation.outcome(1).reason == "rank 1 exited with code 1"


@pytest.mark.skipif(os.geteuid() != 0, reason="NOT TESTED: an EFS volume is mounted, which needs root")
def test_nodes_have_the_file_system_where_the_engine_says(aws: Serving, tmp_path: Path) -> None:
    bench = AwsBench(aws, tmp_path, file_system="fs-1", store=str(tmp_path / "mount"))
    handle = bench.launch(bench.gang("touch $MUSTER_STORE/models", 1, run="mounted"))
    assert [node.exit_code for node in bench.ended(handle)] == [0]
    volume = Store(aws.home / "store")  # what lies on the file system of whatever plays AWS
    assert read_epoch(volume.run("mounted")) == 1 and (volume.path / "models").exists()
    assert list((tmp_path / "mount").iterdir()) == [], "nobody else sees it there"
    bench.close()


@pytest.mark.parametrize(
    ("epoch", "claim", "output"),
    [
        (9, (), "the run now belongs to epoch 9"),
        (1, (Claim("", "another-job", 2),), "attempt 2 of job another-job has epoch 1 already; leaving"),
    ],
)
def test_a_run_of_another_attempt_refuses_it(
    bench: AwsBench, epoch: int, claim: tuple[Claim, ...], output: str
) -> None:
    volume = bench.volume.run("run")
    volume.create({"run": "run"})
    raise_epoch(volume, epoch, *claim)
    [node] = bench.ended(bench.launch(bench.gang("echo wrote", 1)))
    assert node.exit_code == 3 and read_epoch(volume) == epoch
    lines = [line.text for line in bench.lines()]
    assert not any("wrote" in line for line in lines) and any(output in line for line in lines), lines


def test_a_gang_that_waits_says_why_also_while_aws_is_away(bench: AwsBench, monkeypatch: pytest.MonkeyPatch) -> None:
    handle = bench.launch(bench.gang(nodes=1, placements=[Placement("aws-batch/default", (), 500, 64)]))

    def reason() -> str:
        [node] = status_of(bench.engine, handle)
        assert node.running
        return node.words if "500" in node.words else ""

    output = wait_for(reason, 10, "the reason")
    assert output.startswith("AWS Batch: ") and "CPUs" in output
    limit = bench.engine.capacity().limits
    assert isinstance(limit, Limit) and limit.queue == "aws-batch/default" and limit.resources.cpus > 0
    absent = AwsBench(bench.aws, bench.home)
    nowhere = boto3.client("batch", region_name="us-east-1", endpoint_url="http://127.0.0.1:9")
    absent.engine._batch = absent.engine._submitting = nowhere  # AWS was there at the start
    [node] = status_of(absent.engine, handle)
    assert node.running and "does not answer" in node.words and node.stale == node.words
    bench.engine._batch, existing = nowhere, bench.engine._batch
    monkeypatch.setattr(aws_batch, "_ENDING", 0.1)
    with pytest.raises(
        Transient, match=r"^the aws-batch engine has not ended gang .*; last answer: AWS Batch does not"
    ):
        bench.engine.stop(handle, 0)
    [node] = status_of(bench.engine, handle)
    assert "500" in node.words and "does not answer" in node.stale, "the last status, reported as an old one"
    monkeypatch.setattr(aws_batch, "_CAPACITY_AGE", 0.0)
    with pytest.raises(NotYet, match="AWS Batch does not tell its capacity"):
        bench.engine.capacity()
    bench.engine._batch = existing
    assert bench.engine.capacity().limits == limit
    with pytest.raises(NotYet, match="does not answer"):
        absent.engine.launch(absent.engine.plan(bench.gang(attempt=2)))


MOUNTS = """\
22 1 259:1 / / rw - ext4 /dev/root rw
40 22 0:50 / /muster/volume rw - nfs4 fs-1.efs.us-east-1.amazonaws.com:/ rw
41 22 0:51 / /home rw - nfs4 server:/home rw
42 22 0:52 / /tunnel rw - nfs4 127.0.0.1:/ rw
"""


@pytest.mark.parametrize(
    ("path", "volume", "found"),
    [
        ("/muster/volume/muster", "fs-1", True),
        ("/muster/volume/muster", "fs-2", False),
        ("/tunnel/store", "fs-1", True),
        ("/home/me/.muster/store", "fs-1", False),
        ("/home/me/.muster/store", None, True),
        ("/var/store", None, False),
    ],
)
def test_a_store_that_is_mounted_from_the_volume_is_the_volume(path: str, volume: str | None, found: bool) -> None:
    assert is_mounted_from(Path(path), volume, MOUNTS) is found


def test_a_missing_configuration_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match=r"aws\.json is missing: .*muster aws up"):
        AwsBatchEngine(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"regoin": "eu-west-1"}', "unknown key 'regoin'; did you mean region?"),
        ('{"region": "eu-west-1", "image": "i"}', "job_queue: is required"),
        ('{"region": "eu-west-1", "job_queue": "q", "image": "i", "poll": "2"}', "poll: expected a number, found a string ('2')"),
        ('{"region": "eu-west-1", "job_queue": "q", "image": "i", "poll": 0}', "poll: expected a value greater than 0, found 0"),
        ('{"region": null, "job_queue": "q", "image": "i"}', "region: expected a string, found nothing"),
        ("[]", "expected an object, found a list; `muster aws up` writes it anew"),
        ('{"region":', "Invalid JSON: EOF while parsing a value at line 1 column 10; `muster aws up` writes it anew"),
    ],
)  # fmt: skip
def test_a_damaged_configuration_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "aws.json").write_text(text)
    with pytest.raises(EngineError) as refused:
        AwsBatchEngine(tmp_path)
    assert str(refused.value) == f"{tmp_path / 'aws.json'}: {message}"


def test_an_unusable_endpoint_queue_or_key_is_reported_at_the_start(aws: Serving, tmp_path: Path) -> None:
    with pytest.raises(EngineError, match=r"127\.0\.0\.1:9\) does not answer: .*endpoint_url in aws\.json"):
        AwsBench(aws, tmp_path / "away", endpoint_url="http://127.0.0.1:9")
    with pytest.raises(EngineError, match="has no job queue robots; see `muster aws status`"):
        AwsBench(aws, tmp_path / "queue", job_queue="robots")
    assert call_muster("keys", "create", "alice", home=tmp_path / "keyed").returncode == 0
    with Serving(tmp_path / "keyed") as keyed, pytest.raises(EngineError, match=r"refuses: .*; see `aws configure`"):
        AwsBench(keyed, tmp_path / "credentials")


def test_the_doctor_looks_at_the_configuration_that_the_controller_has(bench: AwsBench) -> None:
    examined = call_muster("doctor", "--engine", "aws-batch", home=bench.home)
    assert examined.returncode == 0, examined.stdout
    assert re.search(r"ok  engine aws-batch queue aws-batch/default, at most \d+ CPUs for a gang\n", examined.stdout)


def _supervisor(bench: AwsBench, node: int) -> int:
    found = processes_of(bench.aws.home, AWS_BATCH_JOB_NODE_INDEX=str(node))
    return next(pid for pid in found if "worker.aws_node" in command(pid)[:5])
