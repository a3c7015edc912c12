"""The controller with real gangs: order, failure policies, retries, requeues, stops, time-outs, crashes, no orphans."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.conftest import MAIN_LAST, MUSTER, PATIENCE, Serving, submit_gang, wait_for
from tests.support.orchestrator.jobs import FOREVER, await_status, detail, serving
from tests.support.processes import processes_of

NATIVE = {"MUSTER_ON_CHILD_FAILURE": "restart"}


def until(gate: Path) -> str:
    """A line of a script that imports ``time``: wait until there is a file."""
    return f"while not __import__('os').path.exists({str(gate)!r}): time.sleep(0.02)"


FAULTY = "import os\ndef reward():\n  raise ValueError(os.environ['AWS_BATCH_JOB_ATTEMPT'])\nreward()"


def test_the_same_fault_twice_is_not_tried_a_third_time(shared_server: Serving) -> None:
    found = shared_server.wait(shared_server.gang(FAULTY, attempts=5, env=NATIVE))
    fault = "ValueError in <string>, line 3"
    assert found["status"] == "FAILED" and [each["fault"] for each in found["attempts"]] == [fault] * 2
    assert found["statusReason"] == (
        "main node: rank 0 exited with code 1: ValueError: 2 (ValueError in <string>, line 3 ended the attempt before, too: "
        "not tried again after 2 of 5 attempts; correct it before you resume or submit again)"
    )
    assert [each["exitCode"] for each in found["attempts"]] == [1, 1] and all(
        each["spent"] for each in found["attempts"]
    )


def test_a_job_of_the_batch_api_is_tried_as_often_as_it_says_whatever_its_fault(shared_server: Serving) -> None:
    found = shared_server.wait(shared_server.gang(FAULTY, attempts=3))
    assert found["status"] == "FAILED" and [each["fault"] for each in found["attempts"]] == [None] * 3
    words = "main node: rank 0 exited with code 1: ValueError: 3"
    assert found["statusReason"] == found["attempts"][-1]["statusReason"] == words
    assert found["awsCode"] == "Essential container in task exited"


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
        reported = wait_for(lambda: len(found := lines(asleep)) == 2 and found, 60, "two nodes")
        os.kill(int(reported[1].split()[2]), signal.SIGTERM)
        wait_for(lambda: len(processes_of(tmp_path)) == 3, 60, "node 1's end")
        assert detail(client, asleep)["status"] == "RUNNING"
        os.kill(int(reported[0].split()[1]), signal.SIGKILL)
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
