"""Those who follow a log: counted by key, small in memory, and let go when they take nothing."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from orchestrator.api.http import answer_streams as following
from orchestrator.api.http import connections
from tests.conftest import Serving, submit_gang, wait_for
from tests.support.orchestrator.jobs import await_status, serving

MEGABYTES = 20
CHATTER = f"line = 'some words ' * 40 + chr(10)\nprint(line * ({MEGABYTES} * 2**20 // len(line)))"
SILENT = 120


@contextmanager
def silent_follower(url: str, job: str) -> Iterator[socket.socket]:
    """A client that asks for a log and reads nothing."""
    address = httpx.URL(url)
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(60)
        connection.connect((address.host, address.port or 0))
        connection.sendall(f"GET /api/jobs/{job}/logs?follow=true HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        yield connection


def memory_of(process: int) -> int:
    """Resident memory [MiB]."""
    status = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith("VmRSS")) // 1024


def test_a_hundred_followers_that_never_read_cost_little_memory_and_no_one_waits_for_them(tmp_path: Path) -> None:
    with Serving(tmp_path / "home", "--cpus", "1") as server, ExitStack() as stack:
        job = server.gang(CHATTER)
        assert server.wait(job)["status"] == "SUCCEEDED"
        before = memory_of(server.process.pid)
        readers = [stack.enter_context(silent_follower(server.url, job)) for _ in range(SILENT)]
        took = []
        for _ in range(30):
            started = time.monotonic()
            assert httpx.get(f"{server.url}/healthz", timeout=30).status_code == 200
            took.append(time.monotonic() - started)
            time.sleep(0.1)
        assert sorted(took)[len(took) // 2] < 1.0, took
        assert memory_of(server.process.pid) - before < SILENT * 3 // 2
        refused = [answer for reader in readers if b" 429 " in (answer := reader.recv(600).split(b"\r\n")[0])]
        assert len(refused) == SILENT - following.MOST
        answer = httpx.get(f"{server.url}/api/jobs/{job}/logs", params={"follow": True}, timeout=30)
        assert answer.status_code == 429 and "logs and pages already; close some" in answer.json()["message"]


def test_a_follower_that_takes_nothing_is_closed_and_its_place_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "_FLUSH_TIMEOUT", 0.5)
    monkeypatch.setattr(following, "MOST", 1)
    with serving(tmp_path / "home") as client:
        job = submit_gang(client, CHATTER)
        await_status(client, job, "SUCCEEDED")
        with silent_follower(client.url, job) as reader:
            wait_for(lambda: following._open.total() == 1, 30, "the follower")
            wait_for(lambda: following._open.total() == 0, 30, "that it is closed")
            received = 0
            with suppress(ConnectionError):
                while piece := reader.recv(1 << 20):
                    received += len(piece)
            assert received < MEGABYTES << 19, "it was cut off"
        assert sum(1 for _ in client.logs(job, follow=True)) > 1000, "one that reads gets all"
