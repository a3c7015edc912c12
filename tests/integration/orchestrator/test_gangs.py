"""The controller with real gangs: order, failure policies, retries, requeues, stops, time-outs, crashes, no orphans."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from orchestrator.api.batch import rules
from orchestrator.api.native import continuing
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.domain.gang import GangSpec, gang_needs
from orchestrator.engines.api import EngineError
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.persistence import gangs
from orchestrator.server import Server
from orchestrator.spec.compile import compile_definition, compile_submission
from orchestrator.spec.model import validate
from tests.conftest import MAIN_LAST, MUSTER, PATIENCE, Serving, submit_gang, wait_for
from tests.support.orchestrator.jobs import await_status, detail
from tests.support.processes import parent, processes_of, processes_of_job

NATIVE = {"MUSTER_ON_CHILD_FAILURE": "restart"}

PRINT_CONTRACT = """
import os, json
names = [n for n in os.environ if n.startswith(('AWS_', 'MASTER_', 'NODE_', 'NNODES', 'RANK', 'WORLD', 'MUSTER_'))]
print(json.dumps({n: os.environ[n] for n in names}))
"""

FAIL_ON_CHILD_ONCE = """
import os, sys, time
if os.environ['AWS_BATCH_JOB_NODE_INDEX'] == '1' and os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1':
    raise RuntimeError('child trouble')
if os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1':
    time.sleep(120)
print('attempt', os.environ['AWS_BATCH_JOB_ATTEMPT'], 'done')
"""


def test_every_node_gets_the_contract_of_aws_and_of_torch(shared_server: Serving) -> None:
    job = shared_server.gang(PRINT_CONTRACT + MAIN_LAST, nodes=3)
    shared_server.wait(job)
    nodes = [json.loads(shared_server.log(job, node=k, rank=k)[0]) for k in range(3)]
    main, first, second = nodes
    address = "AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS"
    assert address not in main and first[address] == second[address] == main["MASTER_ADDR"]
    assert [node["AWS_BATCH_JOB_ID"] for node in nodes] == [f"{job}#0", f"{job}#1", f"{job}#2"]
    assert {node["MASTER_PORT"] for node in nodes} == {main["MASTER_PORT"]}
    assert [node["RANK"] for node in nodes] == ["0", "1", "2"] and {node["WORLD_SIZE"] for node in nodes} == {"3"}
    assert len({node["MUSTER_ADDRESS"] for node in nodes}) == 3
    assert main["MUSTER_ADDRESS"] == main["MASTER_ADDR"]
    for name in ("AWS_BATCH_CE_NAME", "AWS_BATCH_JQ_NAME", "AWS_EXECUTION_ENV", "MUSTER_STORE", "MUSTER_EPOCH"):
        assert all(node[name] for node in nodes)


def test_through_the_batch_api_a_childs_death_changes_nothing(shared_server: Serving) -> None:
    script = "import os, sys; time.sleep(1.5) if os.environ['RANK'] == '0' else sys.exit(3)"
    job = shared_server.gang(MAIN_LAST + script, nodes=2)
    detail = shared_server.wait(job)
    assert detail["status"] == "SUCCEEDED"
    assert detail["attempts"][0]["nodes"][1]["exitCode"] == 3


def test_the_main_nodes_end_ends_the_job_and_its_children(shared_server: Serving) -> None:
    job = shared_server.gang("import os, time; time.sleep(0 if os.environ['RANK'] == '0' else 300)", nodes=3)
    detail = shared_server.wait(job, timeout=20)
    assert detail["status"] == "SUCCEEDED"
    assert not processes_of_job(job)


def test_a_native_jobs_child_failure_restarts_the_whole_gang(shared_server: Serving) -> None:
    job = shared_server.gang(FAIL_ON_CHILD_ONCE, nodes=2, attempts=2, env=NATIVE)
    detail = shared_server.wait(job)
    assert detail["status"] == "SUCCEEDED"
    first, second = detail["attempts"]
    assert first["ending"] == "failed"
    assert "node 1: rank 1 exited with code 1: RuntimeError: child trouble" in first["statusReason"]
    assert second["epoch"] > first["epoch"] and second["number"] == 2
    assert "attempt 2 done" in shared_server.log(job, attempt=2)


def test_attempts_are_spent_and_then_the_job_fails(shared_server: Serving) -> None:
    job = shared_server.gang("raise SystemExit(9)", nodes=1, attempts=2)
    detail = shared_server.wait(job)
    assert detail["status"] == "FAILED" and len(detail["attempts"]) == 2
    assert detail["statusReason"] == "Essential container in task exited", "AWS's own words"
    assert "exited with code 9" in detail["attempts"][1]["nodes"][0]["reason"]
    native = shared_server.wait(shared_server.gang("raise SystemExit(9)", nodes=1, attempts=2, env=NATIVE))
    assert "exited with code 9" in native["statusReason"] and "attempt 2 of 2" in native["statusReason"]


def test_on_child_failure_fail_ends_the_job_at_once(shared_server: Serving) -> None:
    job = shared_server.gang(FAIL_ON_CHILD_ONCE, nodes=2, attempts=5, env={"MUSTER_ON_CHILD_FAILURE": "fail"})
    detail = shared_server.wait(job)
    assert detail["status"] == "FAILED" and len(detail["attempts"]) == 1 and "child trouble" in detail["statusReason"]


def test_leaving_on_request_requeues_without_spending_an_attempt(shared_server: Serving) -> None:
    script = "import os, time, sys; first = os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1'; time.sleep(10.5 * first); sys.exit(75 * first)"
    job = shared_server.gang(script, attempts=1, env=NATIVE)
    detail = shared_server.wait(job)
    assert detail["status"] == "SUCCEEDED"
    assert [attempt["spent"] for attempt in detail["attempts"]] == [False, True]


def test_a_job_that_outlives_its_timeout_is_ended_and_not_tried_again(server: Serving) -> None:
    job = server.gang("import time; time.sleep(300)", timeout=60, attempts=3)
    server.wait(job, "RUNNING")
    # the clock that counts is the attempt's start: set it back instead of waiting a minute
    import sqlite3

    with sqlite3.connect(server.home / "muster.db") as database:
        database.execute("UPDATE attempts SET running_since = running_since - 59000")
    detail = server.wait(job, timeout=30)
    assert detail["status"] == "FAILED" and detail["statusReason"] == "Job attempt duration exceeded timeout"
    assert len(detail["attempts"]) == 1


def test_a_job_waits_for_room_and_says_why(server: Serving) -> None:
    first = server.gang("import time; time.sleep(300)", nodes=3, cpus="1", name="big")
    server.wait(first, "RUNNING")
    second = server.gang("print('ran')", nodes=2, cpus="1", name="small")
    reason = wait_for(lambda: (r := server.detail(second)["statusReason"]) and "needs" in r and r, what="a reason")
    wanted = (
        "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - needs 2 nodes with 2 CPUs, 0 GPUs, 32 MiB in all; 1 CPU, 0 GPUs, "
    )
    assert reason == wanted + reason.split("GPUs, ")[2]
    assert reason.endswith(f"free until job big ({first[:8]}) ends")
    impossible = server.gang("pass", nodes=1, cpus="64", name="impossible")
    reason = wait_for(
        lambda: (r := server.detail(impossible)["statusReason"]) and "MISCONF" in r and r, what="a reason"
    )
    assert "each node needs 64 CPUs" in reason and "the largest host has 4 CPUs" in reason
    assert server.muster("stop", first).returncode == 0
    assert server.wait(second)["status"] == "SUCCEEDED"
    server.client.batch("TerminateJob", jobId=impossible, reason="never mind")
    assert server.wait(impossible)["statusReason"] == "never mind"


def test_a_program_that_can_not_start_fails_with_the_reason(shared_server: Serving) -> None:
    job = shared_server.gang("pass")
    shared_server.wait(job)
    needs = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}]
    container = {"image": "muster", "command": ["no-such-program"], "resourceRequirements": needs}
    registered = shared_server.client.batch(
        "RegisterJobDefinition",
        jobDefinitionName="nothing",
        type="multinode",
        nodeProperties={
            "numNodes": 1,
            "mainNode": 0,
            "nodeRangeProperties": [{"targetNodes": "0", "container": container}],
        },
    )
    job = shared_server.client.batch(
        "SubmitJob", jobName="nothing", jobQueue="default", jobDefinition=registered["jobDefinitionArn"]
    )
    detail = shared_server.wait(job["jobId"])
    assert detail["status"] == "FAILED"
    assert "can't start 'no-such-program'" in detail["attempts"][0]["nodes"][0]["reason"]


def test_a_killed_supervisor_of_a_native_gang_costs_one_attempt_and_leaves_no_orphan(server: Serving) -> None:
    script = "import os, time; print('pid', os.getpid()); time.sleep(300 if os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1' else 0.2)"
    job = server.gang(script, nodes=3, attempts=2, env=NATIVE)
    server.wait(job, "RUNNING")
    line = wait_for(lambda: server.log(job, node=2), what="node 2's first line")[0]
    first = set(processes_of(server.home))
    os.kill(parent(int(line.split()[1])), signal.SIGKILL)
    detail = server.wait(job)
    assert detail["status"] == "SUCCEEDED" and len(detail["attempts"]) == 2
    assert "died without an outcome" in detail["attempts"][0]["statusReason"]
    assert not first & set(processes_of(server.home))


def test_a_controller_killed_in_mid_run_finds_its_gang_again(server: Serving) -> None:
    script = "import time\nfor i in range(60): print('tick', i); time.sleep(0.1)"
    job = server.gang(script, nodes=2)
    server.wait(job, "RUNNING")
    follower = subprocess.Popen(
        [MUSTER, "logs", job, "-f", "--json"],
        env={**os.environ, "MUSTER_HOME": str(server.home)},
        bufsize=0,  # communicate() would lose what readline() read ahead
        stdout=subprocess.PIPE,
    )
    assert follower.stdout is not None
    first = follower.stdout.readline()
    before = set(
        wait_for(lambda: len(found := processes_of(server.home)) == 6 and found, what="two shims, supervisors, ranks")
    )
    server.kill()
    time.sleep(0.3)
    assert set(processes_of(server.home)) == before
    server.start()
    detail = server.wait(job)
    assert detail["status"] == "SUCCEEDED" and len(detail["attempts"]) == 1
    assert [line for line in server.log(job, rank=1)] == [f"tick {i}" for i in range(60)]
    followed = [json.loads(line) for line in [first, *follower.communicate(timeout=30 * PATIENCE)[0].splitlines()]]
    for rank in (0, 1):  # the follower took up where it was: no line twice, none left out
        assert [line["text"] for line in followed if line["rank"] == rank] == [f"tick {i}" for i in range(60)]


def test_a_gang_that_ends_while_no_controller_runs_is_judged_by_its_outcomes(server: Serving) -> None:
    failing = server.gang("import time; time.sleep(2); raise ValueError('late')", name="late")
    server.wait(failing, "RUNNING")
    server.kill()
    wait_for(lambda: not processes_of(server.home), what="the gang's end")
    server.start()
    detail = server.wait(failing)
    assert detail["status"] == "FAILED" and "ValueError: late" in detail["attempts"][0]["nodes"][0]["reason"]


def test_following_a_log_shows_lines_as_they_come_and_ends_with_the_job(shared_server: Serving) -> None:
    job = shared_server.gang("import time\nfor i in range(5): print('line', i); time.sleep(0.3)")
    arrivals = [(time.monotonic(), line["text"]) for line in shared_server.client.logs(job, follow=True)]
    texts = [text for _, text in arrivals]
    assert texts == [f"line {i}" for i in range(5)] + ["node 0 ended: done"]
    assert arrivals[4][0] - arrivals[0][0] > 0.8, "the lines came all at once: nothing was followed"


def test_two_jobs_can_not_write_one_run(server: Serving) -> None:

    server.gang("import time; time.sleep(300)", env={"MUSTER_RUN": "shared-run"})
    with pytest.raises(ApiError, match="run shared-run is being written by job test"):
        server.gang("pass", env={"MUSTER_RUN": "shared-run"})


def test_a_gang_that_the_engine_can_t_stop_says_so_until_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stop, asked, allowed = LocalEngine.stop, [], threading.Event()

    def stop_if_allowed(engine: LocalEngine, handle: str, grace: float) -> None:
        asked.append(handle)
        if not allowed.is_set():
            raise EngineError("not authorized\nto perform TerminateJob")
        stop(engine, handle, grace)

    monkeypatch.setattr(LocalEngine, "stop", stop_if_allowed)
    server = Server(tmp_path, port=0, cpus=2)
    server.start()
    try:
        with Client(server.url) as client:
            job = submit_gang(client, "import time; time.sleep(600)")
            await_status(client, job, "RUNNING")
            client.batch("TerminateJob", jobId=job, reason="enough")
            wait_for(lambda: len(asked) > 2, 30, "another try")
            said = "attempt 1 can't be stopped: not authorized to perform TerminateJob; trying again"
            found = detail(client, job)
            assert (found["status"], found["statusReason"]) == ("RUNNING", said)
            allowed.set()
            assert await_status(client, job, "FAILED")["statusReason"] == "enough"
    finally:
        server.close()
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [f"job {job}: {said}"]
    assert processes_of(tmp_path) == []


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of nodes of each document that is read for its gang, in order."""
    found: list[int] = []

    def counting(node_properties: Mapping[str, Any]) -> GangSpec:
        found.append(node_properties["numNodes"])
        return gang_needs(node_properties)

    for module in (rules, gangs, continuing):
        monkeypatch.setattr(module, "gang_needs", counting)
    return found


def test_a_definition_and_a_job_are_read_once_each_from_submission_to_end(tmp_path: Path, read: list[int]) -> None:
    server = Server(tmp_path, port=0, cpus=2)
    server.start()
    try:
        with Client(server.url) as client:
            job = submit_gang(client, "import time; time.sleep(1)" + MAIN_LAST, nodes=2, env=NATIVE)
            await_status(client, job, "SUCCEEDED")
            assert len(detail(client, job)["attempts"][0]["nodes"]) == 2
    finally:
        server.close()
    assert read == [2, 2], "when the definition is registered, and when the job is submitted with its overrides"


def test_a_resumed_job_is_read_once_for_its_definition_and_once_with_overrides(tmp_path: Path, read: list[int]) -> None:
    spec = validate({"name": "say", "command": ["echo", "here"], "resources": {"cpus": 0.1, "memory": 64}}, "job.yaml")
    server = Server(tmp_path, port=0, cpus=2)
    server.start()
    try:
        with Client(server.url) as client:
            registered = client.batch("RegisterJobDefinition", **compile_definition(spec, str(tmp_path)))
            submitted = client.batch("SubmitJob", **compile_submission(spec, registered["jobDefinitionArn"]))
            run = await_status(client, submitted["jobId"], "SUCCEEDED")["run"]
            read.clear()
            resumed = client.post(f"/api/runs/{run}/resume", {})["jobId"]
            await_status(client, resumed, "SUCCEEDED")
            client.batch("DescribeJobs", jobs=[resumed, f"{resumed}#0"])
            client.batch("ListJobs", multiNodeJobId=resumed, jobStatus="SUCCEEDED")
    finally:
        server.close()
    assert read == [1, 1]
