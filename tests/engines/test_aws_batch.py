"""The aws-batch engine on a second Muster, which plays AWS: boto3 reaches it as it would reach AWS itself.

The controller and its store are one home directory, "AWS" and the volume of its nodes are another.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.engines.aws_batch import AwsBatchEngine
from orchestrator.engines.aws_config import AwsConfig, save_config
from orchestrator.engines.base import EngineError, Gang, NodeStatus, NotYet, Placement
from shared_store.epoch import raise_epoch, read_epoch
from shared_store.layout import Store
from shared_store.logs import LogFollower
from shared_store.outcomes import Outcome, read_outcome
from tests.conftest import Serving, processes_of, wait_for

JOB = "6f1d0c5e-0000-4000-8000-00000000aaaa"
WAIT = "echo ready; exec sleep 600"
TRAP = 'trap "echo saved; exit 75" TERM; echo ready; while :; do sleep 0.05; done'


@pytest.fixture(scope="module")
def aws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """The second Muster."""
    os.environ.update(AWS_ACCESS_KEY_ID="any", AWS_SECRET_ACCESS_KEY="any")
    serving = Serving(tmp_path_factory.mktemp("aws"), "--cpus", "16")
    yield serving
    serving.close()


class Bench:
    """A controller's home and store, the volume that the nodes have, and the engine between them."""

    def __init__(self, aws: Serving, home: Path, **config: Any) -> None:
        self.aws, self.home = aws, home
        self.volume = Store(home / "efs").open()
        self.store = self.volume if config.get("store_is_shared") else Store(home / "store").open()
        settings = {"store": str(self.volume.path), "poll": 0.1, "store_is_shared": False, **config}
        save_config(home, AwsConfig("us-east-1", "default", "muster", endpoint_url=aws.url, **settings))
        self.engine = AwsBatchEngine(home)
        self.handles: list[str] = []
        self.run = self.store.run("run")

    def gang(self, script: str = WAIT, nodes: int = 2, *, attempt: int = 1, native: bool = True, **changes: Any) -> Gang:
        environment = {"GREETING": "hello", **({"MUSTER_ON_CHILD_FAILURE": "restart"} if native else {})}
        self.run.create({"run": "run"})
        if read_epoch(self.run) < attempt:
            raise_epoch(self.run, attempt)
        values: dict[str, Any] = {
            "job": JOB,
            "attempt": attempt,
            "epoch": attempt,
            "job_epoch": 1,
            "run": "run",
            "store": str(self.store.path),
            "queue": "default",
            "pool": "aws",
            "main": 0,
            "commands": [["sh", "-c", script]] * nodes,
            "environments": [environment] * nodes,
            "placements": [Placement("aws-batch/default", (), 0.5, 64)] * nodes,
            "grace": 5.0,
            "directory": "/no/such/directory",
            "containers": [{"image": "muster" if native else "busybox"}] * nodes,
            "title": self.home.name.replace("_", "-"),
        }
        return Gang(**{**values, **changes})

    def launch(self, gang: Gang) -> str:
        def launched() -> str | None:
            try:
                return self.engine.launch(self.engine.plan(gang))
            except NotYet:
                return None

        handle: str = wait_for(launched, 10, "the launch")
        self.handles.append(handle)
        return handle

    def ended(self, handle: str, engine: AwsBatchEngine | None = None) -> list[NodeStatus]:
        def over() -> list[NodeStatus] | None:
            status = list((engine or self.engine).observe(handle))
            return status if not any(node.running for node in status) else None

        found: list[NodeStatus] = wait_for(over, 40, "the gang's end")
        return found

    def log(self, attempt: int = 1) -> list[str]:
        lines = LogFollower(self.run, JOB).drain()
        return [line.text for line in lines if line.attempt == attempt and line.rank is not None]

    def ready(self, count: int, attempt: int = 1) -> None:
        def there() -> bool:
            self.engine.observe(self.handles[-1])  # a controller looks all the time
            return self.log(attempt).count("ready") == count

        wait_for(there, 30, f"{count} ready nodes")

    def outcome(self, node: int, attempt: int = 1) -> Outcome:
        found = read_outcome(self.run, JOB, attempt, node)
        assert found is not None, (node, self.log(attempt))
        return found

    def processes(self) -> list[int]:
        """Of all nodes: those that "AWS" runs, and those that see the volume."""
        return [*processes_of(self.aws.home), *processes_of(self.volume.path)]


@pytest.fixture
def bench(aws: Serving, tmp_path: Path) -> Iterator[Bench]:
    found = Bench(aws, tmp_path)
    yield found
    close(found)


@pytest.fixture
def workstation(aws: Serving, tmp_path: Path) -> Iterator[Bench]:
    """A controller whose store is the volume itself."""
    found = Bench(aws, tmp_path, store_is_shared=True)
    yield found
    close(found)


def close(bench: Bench) -> None:
    for handle in bench.handles:
        bench.engine.stop(handle, 0.0)
    assert bench.processes() == []


PRINT = "env | grep -E '^(AWS_|MASTER_|MUSTER_|NODE_RANK|NNODES|RANK|WORLD_SIZE|GREETING)' | sort"


def test_a_gang_of_three_has_the_exact_contract_and_its_log_and_outcomes_come_home(bench: Bench) -> None:
    handle = bench.launch(bench.gang(f"{PRINT}; [ $NODE_RANK != 0 ] || sleep 1; exit $((NODE_RANK * 0))", 3, main=1))
    assert [node.exit_code for node in bench.ended(handle)] == [0, 0, 0], bench.log()
    facts = json.loads(handle)
    lines = [line for line in LogFollower(bench.run, JOB).drain() if line.rank is not None]
    told = [dict(line.text.split("=", 1) for line in lines if line.node == index) for index in range(3)]
    main = told[1]["MUSTER_ADDRESS"]
    for index, env in enumerate(told):
        assert env["GREETING"] == "hello" and env["MUSTER_ON_CHILD_FAILURE"] == "restart"
        assert (env["MASTER_ADDR"], env["MASTER_PORT"], env["NNODES"], env["WORLD_SIZE"]) == (main, "29500", "3", "3")
        assert env["NODE_RANK"] == env["RANK"] == str({1: 0, 0: 1, 2: 2}[index])
        assert env["AWS_BATCH_JOB_ID"] == f"{facts['aws']}#{index}", "AWS's own"
        assert (env["AWS_BATCH_JOB_NODE_INDEX"], env["AWS_BATCH_JOB_MAIN_NODE_INDEX"]) == (str(index), "1")
        assert env.get("AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS") == (None if index == 1 else main)
        assert (env["MUSTER_JOB_ID"], env["MUSTER_RUN"], env["MUSTER_EPOCH"]) == (JOB, "run", "1")
        assert env["MUSTER_STORE"] == str(bench.volume.path) and env["MUSTER_GANG"] == f"{JOB}/1/1"
        assert not {"MUSTER_NODE", "MUSTER_ENVIRONMENT", "MUSTER_BUS", "MUSTER_BUS_TOKEN"} & set(env)
    assert len({env["MUSTER_ADDRESS"] for env in told}) == 3
    assert [bench.outcome(index).reason for index in range(3)] == ["done"] * 3
    volume = bench.volume.run("run")
    assert read_epoch(volume) == 1 and volume.description() is not None, "the nodes made the run on their volume"


def test_one_node_that_fails_tells_why_with_the_error_of_its_rank(bench: Bench) -> None:
    script = (
        "import json, os, time\n"
        "error = {'message': {'message': 'RuntimeError: no', 'extraInfo': {'py_callstack': 'trace', 'timestamp': '1'}}}\n"
        "json.dump(error, open(os.environ['TORCHELASTIC_ERROR_FILE'], 'w')); raise SystemExit(3)"
    )
    handle = bench.launch(bench.gang(nodes=1, commands=[["python", "-c", script]]))
    [node] = bench.ended(handle)
    outcome = bench.outcome(0)
    assert node.exit_code == 3 and outcome.exit_code == 3
    assert outcome.error is not None and outcome.error.message == "RuntimeError: no", outcome
