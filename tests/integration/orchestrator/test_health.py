"""What the controller says of its own health: over HTTP, to a service manager, and where its database has no connection left."""

from __future__ import annotations

import os
import socket
import threading
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from orchestrator.client import Client
from orchestrator.control import monitoring
from orchestrator.server import Server
from orchestrator.service_manager import ServiceManager
from tests.conftest import Serving, submit_gang, wait_for
from tests.support.orchestrator.jobs import await_status


def test_a_loop_that_is_stuck_makes_the_health_check_fail(inside: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, poll = threading.Event(), inside.controller.engines.poll
    health = lambda: httpx.get(f"{inside.url}/healthz", timeout=30)  # noqa: E731
    assert health().status_code == 200
    monkeypatch.setattr(inside.controller.engines, "poll", lambda: (gate.wait(120), poll()))
    try:
        wait_for(lambda: health().status_code == 503, 60, "that the loop is stuck")
        assert "the controller's loop has made no progress for" in health().json()["message"]
        metrics = httpx.get(f"{inside.url}/metrics", timeout=30).text
        age = next(line for line in metrics.splitlines() if line.startswith("muster_loop_age_seconds "))
        assert float(age.split()[1]) > monitoring.LATE
    finally:
        gate.set()
    wait_for(lambda: health().status_code == 200, 60, "that it goes on")


def test_requests_that_take_every_connection_are_refused_and_leave_the_loop_its_own(tmp_path: Path) -> None:
    server = Server(tmp_path / "home", cpus=2)
    server.start()
    try:
        with ExitStack() as held, Client(server.url) as client:
            job = submit_gang(client, "import time; time.sleep(3)")
            await_status(client, job, "RUNNING")
            engine = server.controller.database.engine
            engine.pool._timeout = 0.5  # type: ignore[attr-defined]
            while True:
                try:
                    held.enter_context(engine.connect())
                except Exception:
                    break
            answer = httpx.get(f"{server.url}/api/jobs", timeout=60)
            assert answer.status_code == 503
            assert "all connections of this controller are busy" in answer.json()["message"]
            wait_for(lambda: not server.controller.work_queue.active(), 60, "that the loop sees the end")
            assert httpx.get(f"{server.url}/healthz").status_code == 200
        with Client(server.url) as client:
            await_status(client, job, "SUCCEEDED")
    finally:
        server.close()


@pytest.mark.parametrize("kind", ["a path", "an abstract address"])
def test_a_service_manager_hears_that_the_controller_is_ready_alive_and_stopping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    address = str(tmp_path / "notify") if kind == "a path" else f"@muster-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address.replace("@", "\0", 1))
        manager.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        with Serving(tmp_path / "home", "--cpus", "1") as server:
            assert [manager.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1"]
            job = server.gang(
                "import os; print(*[name for name in os.environ if name.startswith(('NOTIFY', 'WATCHDOG'))])"
            )
            assert server.wait(job)["status"] == "SUCCEEDED" and server.log(job)[0] == ""
            server.process.terminate()
            while (received := manager.recv(100)) == b"WATCHDOG=1":
                pass
            assert received == b"STOPPING=1"
            assert server.process.wait(60) == 0


def test_a_controller_that_is_not_alive_sends_no_heartbeat(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(60)
        reported = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "20000"})
        is_alive, ended = threading.Event(), threading.Event()
        reported.keep_alive(is_alive.is_set, ended.wait)
        with pytest.raises(TimeoutError):
            manager.settimeout(0.5)
            manager.recv(100)
        is_alive.set()
        manager.settimeout(60)
        assert manager.recv(100) == b"WATCHDOG=1"
        ended.set()


def test_the_watchdog_of_another_process_is_not_ours() -> None:
    supplied = {"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}
    assert ServiceManager(supplied).interval is None and supplied == {}
    ServiceManager({"NOTIFY_SOCKET": "@nobody"}).notify("READY=1")  # a manager that is gone is ignored
