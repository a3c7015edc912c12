"""Stopping through the controller: what the nodes' records say of a gang that had to be killed, and what is never the cause."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from orchestrator.client import Client
from orchestrator.server import Server
from tests.conftest import submit_gang, wait_for
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
