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
from orchestrator.domain.errors import ApiError
from orchestrator.domain.gang import GangSpec, gang_needs
from orchestrator.engines.api import EngineError
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.persistence import gangs
from orchestrator.spec.compile import compile_definition, compile_submission
from orchestrator.spec.model import validate
from tests.conftest import MAIN_LAST, MUSTER, PATIENCE, Serving, submit_gang, wait_for
from tests.support.definitions import container, multinode
from tests.support.orchestrator.jobs import FOREVER, await_status, detail, serving
from tests.support.processes import parent, processes_of

NATIVE = {"MUSTER_ON_CHILD_FAILURE": "restart"}

FAIL_ON_CHILD_ONCE = """
import os, sys, time
if os.environ['AWS_BATCH_JOB_NODE_INDEX'] == '1' and os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1':
    raise RuntimeError('child trouble')
if os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1':
    time.sleep(120)
print('attempt', os.environ['AWS_BATCH_JOB_ATTEMPT'], 'done')
"""


def until(gate: Path) -> str:
    """A line of a script that imports ``time``: wait until there is a file."""
    return f"while not __import__('os').path.exists({str(gate)!r}): time.sleep(0.02)"


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
    other = lambda: (r := server.detail(impossible)["statusReason"]) and "MISCONF" in r and r  # noqa: E731
    reason = wait_for(other, what="a reason")
    assert "each node needs 64 CPUs" in reason and "the largest host has 4 CPUs" in reason
    assert server.muster("stop", first).returncode == 0
    assert server.wait(second)["status"] == "SUCCEEDED"
    server.client.batch("TerminateJob", jobId=impossible, reason="never mind")
    assert server.wait(impossible)["statusReason"] == "never mind"


def test_a_program_that_can_not_start_fails_with_the_reason(shared_server: Serving) -> None:
    client = shared_server.client
    client.batch("RegisterJobDefinition", **multinode("nothing", container(["no-such-program"])))
    job = client.batch("SubmitJob", jobName="nothing", jobQueue="default", jobDefinition="nothing")
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


def test_a_controller_killed_in_mid_run_finds_its_gang_again(server: Serving, tmp_path: Path) -> None:
    script = f"import time\nfor i in range(60):\n  print('tick', i)\n  if i == 30:\n    {until(tmp_path / 'gate')}"
    job = server.gang(script + MAIN_LAST, nodes=2)
    server.wait(job, "RUNNING")
    follower = subprocess.Popen(
        [MUSTER, "logs", job, "-f", "--json"],
        env={**os.environ, "MUSTER_HOME": str(server.home)},
        bufsize=0,  # communicate() would lose what readline() read ahead
        stdout=subprocess.PIPE,
    )
    assert follower.stdout is not None
    first = follower.stdout.readline()
    both = lambda: len(found := processes_of(server.home)) == 6 and found  # noqa: E731
    before = set(wait_for(both, what="two shims, supervisors, ranks"))
    server.kill()
    time.sleep(0.3)
    assert set(processes_of(server.home)) == before
    server.start()
    (tmp_path / "gate").touch()
    detail = server.wait(job)
    assert detail["status"] == "SUCCEEDED" and len(detail["attempts"]) == 1
    assert [line for line in server.log(job, rank=1)] == [f"tick {i}" for i in range(60)]
    followed = [json.loads(line) for line in [first, *follower.communicate(timeout=30 * PATIENCE)[0].splitlines()]]
    for rank in (0, 1):  # the follower took up where it was: no line twice, none left out
        assert [line["text"] for line in followed if line["rank"] == rank] == [f"tick {i}" for i in range(60)]


def test_a_gang_that_ends_while_no_controller_runs_is_judged_by_its_outcomes(server: Serving, tmp_path: Path) -> None:
    failing = server.gang(f"import time\n{until(tmp_path / 'gate')}\nraise ValueError('late')", name="late")
    server.wait(failing, "RUNNING")
    server.kill()
    (tmp_path / "gate").touch()
    wait_for(lambda: not processes_of(server.home), what="the gang's end")
    server.start()
    detail = server.wait(failing)
    assert detail["status"] == "FAILED" and "ValueError: late" in detail["attempts"][0]["nodes"][0]["reason"]


def test_following_a_log_shows_lines_as_they_come_and_ends_with_the_job(shared_server: Serving, tmp_path: Path) -> None:
    lines = "\n".join(f"print('line {i}')\n{until(tmp_path / str(i))}" for i in range(3))
    job = shared_server.gang(f"import time\n{lines}")
    texts = []
    for line in shared_server.client.logs(job, follow=True):
        texts.append(line["text"])
        (tmp_path / texts[-1].removeprefix("line ")).touch()  # the next one is printed once this one has come
    assert texts == [f"line {i}" for i in range(3)] + ["node 0 ended: done"]


def test_two_jobs_can_not_write_one_run(shared_server: Serving) -> None:
    first = shared_server.gang(FOREVER, env={"MUSTER_RUN": "shared-run"})
    with pytest.raises(ApiError, match="run shared-run is being written by job test"):
        shared_server.gang("pass", env={"MUSTER_RUN": "shared-run"})
    shared_server.client.batch("TerminateJob", jobId=first, reason="seen")
    shared_server.wait(first)


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
    with serving(tmp_path) as client:
        job = submit_gang(client, FOREVER)
        await_status(client, job, "RUNNING")
        client.batch("TerminateJob", jobId=job, reason="enough")
        wait_for(lambda: len(asked) > 2, 30, "another try")
        said = "attempt 1 can't be stopped: not authorized to perform TerminateJob; trying again"
        found = detail(client, job)
        assert (found["status"], found["statusReason"]) == ("RUNNING", said)
        allowed.set()
        assert await_status(client, job, "FAILED")["statusReason"] == "enough"
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [f"job {job}: {said}"]
    assert processes_of(tmp_path) == []


def test_a_job_is_read_once_as_defined_and_once_with_overrides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    """The number of nodes of each document that is read for its gang, in order."""

    def counting(node_properties: Mapping[str, Any]) -> GangSpec:
        read.append(node_properties["numNodes"])
        return gang_needs(node_properties)

    for module in (rules, gangs, continuing):
        monkeypatch.setattr(module, "gang_needs", counting)
    spec = validate({"name": "say", "command": ["echo", "here"], "resources": {"cpus": 0.1, "memory": 64}}, "job.yaml")
    with serving(tmp_path) as client:
        job = submit_gang(client, "pass" + MAIN_LAST, nodes=2, env=NATIVE)
        await_status(client, job, "SUCCEEDED")
        assert len(detail(client, job)["attempts"][0]["nodes"]) == 2 and read == [2, 2], "from submission to end"
        registered = client.batch("RegisterJobDefinition", **compile_definition(spec, str(tmp_path)))
        submitted = client.batch("SubmitJob", **compile_submission(spec, registered["jobDefinitionArn"]))
        run = await_status(client, submitted["jobId"], "SUCCEEDED")["run"]
        read.clear()
        resumed = client.post(f"/api/runs/{run}/resume", {})["jobId"]
        await_status(client, resumed, "SUCCEEDED")
        client.batch("DescribeJobs", jobs=[resumed, f"{resumed}#0"])
        client.batch("ListJobs", multiNodeJobId=resumed, jobStatus="SUCCEEDED")
    assert read == [1, 1]


STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); {FOREVER}"
ASLEEP = f"import os; print('pid', os.getpid(), os.getppid(), flush=True); {FOREVER}"


def test_how_a_gang_ended_is_recorded_for_each_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orchestrator.control.attempts.GRACE", 1.0)
    with serving(tmp_path) as client:

        def lines(job: str) -> dict[int, str]:
            return {line["node"]: line["text"] for line in client.logs(job) if line["rank"] is not None}

        stubborn = submit_gang(client, STUBBORN, nodes=2)
        asleep = submit_gang(client, ASLEEP, nodes=2, env=NATIVE)
        wait_for(lambda: len(lines(stubborn)) == 2, 60, "two nodes")
        client.batch("TerminateJob", jobId=stubborn, reason="enough")
        found = await_status(client, stubborn, "FAILED")
        killed = [f"rank {rank} did not leave within 1 s of SIGTERM and was killed" for rank in (0, 1)]
        assert found["statusReason"] == "enough"
        assert [node["reason"] for node in found["attempts"][0]["nodes"]] == killed

        # node 1's supervisor is asked to leave, and rank 0 is killed: node 1 was first, and is not the cause
        told = wait_for(lambda: len(found := lines(asleep)) == 2 and found, 60, "two nodes")
        os.kill(int(told[1].split()[2]), signal.SIGTERM)
        wait_for(lambda: len(processes_of(tmp_path)) == 3, 60, "node 1's end")
        assert detail(client, asleep)["status"] == "RUNNING"
        os.kill(int(told[0].split()[1]), signal.SIGKILL)
        reason = await_status(client, asleep, "FAILED")["statusReason"]
        assert reason.startswith("main node: rank 0 was killed by SIGKILL")


IGNORED = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGCHLD, signal.SIGALRM)
SHOWS_IGNORED = """
import os, re, signal
resettable = sum(1 << number - 1 for number in signal.valid_signals())  # the C library keeps 32 and 33
for pid in os.getpid(), os.getppid():
    ignored = int(re.search("SigIgn:\\s+(\\w+)", open(f"/proc/{pid}/status").read())[1], 16)
    print(ignored & resettable, flush=True)
raise SystemExit(7)
"""
"""Of the rank and of its supervisor, as bits."""


def test_a_job_has_the_default_signals_whatever_its_server_was_started_to_ignore(tmp_path: Path) -> None:
    """``nohup`` ignores SIGHUP, and a shell SIGINT and SIGQUIT for what it runs in the background; children inherit that."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in IGNORED}
    try:
        server = Serving(tmp_path / "home", "--cpus", "2")
    finally:
        for number, action in before.items():
            signal.signal(number, action)
    try:
        server.process.send_signal(signal.SIGHUP)
        job = server.gang(SHOWS_IGNORED)
        assert server.wait(job)["attempts"][0]["nodes"][0]["exitCode"] == 7
        by_python = 1 << signal.SIGPIPE - 1 | 1 << signal.SIGXFSZ - 1
        assert [text for text in server.log(job) if text.isdecimal()] == [str(by_python)] * 2
        assert server.process.poll() is None
    finally:
        server.close()
