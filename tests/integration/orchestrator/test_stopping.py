"""Stopping through the controller: what the nodes' records say of a gang that had to be killed, what is never the cause, and that a
job can be asked to stop whatever the controller ignores."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from orchestrator.client import Client
from orchestrator.server import Server
from tests.conftest import Serving, submit_gang, wait_for
from tests.support.processes import processes_of

STUBBORN = (
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(600)"
)
ASLEEP = "import os, time; print('pid', os.getpid(), os.getppid(), flush=True); time.sleep(600)"


def test_how_a_gang_ended_is_recorded_for_each_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orchestrator.control.attempts.GRACE", 1.0)
    server = Server(tmp_path, port=0, cpus=2)
    server.start()
    try:
        with Client(server.url) as client:

            def over(job: str) -> dict[str, Any]:
                return wait_for(
                    lambda: (d := client.get(f"/api/jobs/{job}"))["status"] == "FAILED" and d, 60, "its end"
                )  # type: ignore[no-any-return]

            def lines(job: str) -> list[dict[str, Any]]:
                return [line for line in client.logs(job) if line["rank"] is not None]

            stubborn = submit_gang(client, STUBBORN, nodes=2)
            asleep = submit_gang(client, ASLEEP, nodes=2, env={"MUSTER_ON_CHILD_FAILURE": "restart"})
            wait_for(lambda: len(lines(stubborn)) == 2, 60, "two nodes")
            client.batch("TerminateJob", jobId=stubborn, reason="enough")
            detail = over(stubborn)
            assert detail["statusReason"] == "enough"
            assert [node["reason"] for node in detail["attempts"][0]["nodes"]] == [
                f"rank {rank} did not leave within 1 s of SIGTERM and was killed" for rank in (0, 1)
            ]

            # node 1's supervisor is asked to leave, and rank 0 is killed: node 1 was first, and is not the cause
            found = wait_for(
                lambda: len(f := {x["node"]: x["text"] for x in lines(asleep)}) == 2 and f, 60, "two nodes"
            )
            os.kill(int(found[1].split()[2]), signal.SIGTERM)
            wait_for(lambda: len(processes_of(tmp_path)) == 3, 60, "node 1's end")
            assert client.get(f"/api/jobs/{asleep}")["status"] == "RUNNING"
            os.kill(int(found[0].split()[1]), signal.SIGKILL)
            assert over(asleep)["statusReason"].startswith("main node: rank 0 was killed by SIGKILL")
    finally:
        server.close()


IGNORED = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGCHLD, signal.SIGALRM)
SHOWS_IGNORED = """
import os, re
for pid in os.getpid(), os.getppid():
    print(int(re.search("SigIgn:\\s+(\\w+)", open(f"/proc/{pid}/status").read())[1], 16), flush=True)
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
