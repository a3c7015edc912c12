"""Connections that send no request give way, and neither jobs nor followers notice them; a client whose answers are lost asks again."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

from orchestrator.api.http import connections
from orchestrator.api.http.connections import Connection, Connections, raise_descriptor_limit
from orchestrator.client import Client
from orchestrator.domain.errors import Unreachable
from orchestrator.server import Server
from tests.conftest import MUSTER, Serving, submit_gang, wait_for
from tests.support.definitions import container, single
from tests.support.orchestrator.jobs import serving

DESCRIPTORS = 1024
HALF_OPEN = 1100
FOLLOWERS = 50
HALF = b"POST /v1/submitjob HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Le"


class Limited(Serving):
    """A server that can't have more open files than many a login shell; what it logs is in ``errors``."""

    command = ("prlimit", f"--nofile={DESCRIPTORS}:{DESCRIPTORS}", MUSTER)

    def start(self) -> None:
        self.home.mkdir(parents=True)
        self.errors = self.home / "serve.log"
        super().start()


def half_open(url: str, sent: bytes = HALF) -> socket.socket:
    address = httpx.URL(url)
    connection = socket.create_connection((address.host, address.port or 0), timeout=60)
    connection.sendall(sent)
    return connection


def test_half_open_connections_keep_no_job_from_starting_and_cut_no_follower(tmp_path: Path) -> None:
    raise_descriptor_limit()  # this process holds the other ends
    with Limited(tmp_path / "home", "--cpus", "4") as server, contextlib.ExitStack() as stack:
        gate = tmp_path / "gate"
        talker = f"import time, pathlib\nprint('first')\nwhile not pathlib.Path({str(gate)!r}).exists(): time.sleep(0.1)\nprint('last')"
        followed = server.gang(talker)
        server.wait(followed, "RUNNING")
        seen: list[list[str]] = [[] for _ in range(FOLLOWERS)]

        def follow(lines: list[str]) -> None:
            with Client(server.url) as client:
                lines += [line["text"] for line in client.logs(followed, follow=True)]

        followers = [threading.Thread(target=follow, args=(lines,), daemon=True) for lines in seen]
        for follower in followers:
            follower.start()
        for _ in range(HALF_OPEN):
            stack.enter_context(half_open(server.url))
        jobs = [server.gang("print('ran')", name=f"job-{number}") for number in range(6)]
        with httpx.Client(base_url=server.url, timeout=60) as fresh:
            assert fresh.get("/healthz").json()["status"] == "ok"
        assert [server.wait(job)["status"] for job in jobs] == ["SUCCEEDED"] * 6
        gate.touch()
        for follower in followers:
            follower.join(180)
        assert all({"first", "last"} <= set(lines) for lines in seen), "a follower was cut"
        assert server.wait(followed)["status"] == "SUCCEEDED"
        log = server.errors.read_text()
        assert "have waited for their client longest are closed first" in log
        assert len(log.splitlines()) < 10 and "Traceback" not in log, log[:2000]


class Scarce(Limited):
    """A server with hardly any open files."""

    command = ("prlimit", "--nofile=256:256", MUSTER)


def test_a_burst_of_connections_leaves_descriptors_for_the_rest(tmp_path: Path) -> None:
    with Scarce(tmp_path / "home") as server, contextlib.ExitStack() as stack:
        assert server.process is not None
        address = httpx.URL(server.url)
        for _ in range(3):
            server.process.send_signal(signal.SIGSTOP)  # while it is stopped, the kernel queues the connections
            for _ in range(300):
                connection = stack.enter_context(socket.socket())
                connection.setblocking(False)
                connection.connect_ex((address.host, address.port or 0))
            server.process.send_signal(signal.SIGCONT)
            with httpx.Client(base_url=server.url, timeout=60, trust_env=False) as fresh:
                assert fresh.get("/healthz").json()["status"] == "ok"
        assert "out of system resource" not in server.errors.read_text()


@pytest.mark.parametrize("sent", [b"", HALF, HALF + b"ngth: 100\r\n\r\n{"])
def test_a_connection_that_does_not_finish_its_request_in_time_is_closed(
    inside: Server, monkeypatch: pytest.MonkeyPatch, sent: bytes
) -> None:
    monkeypatch.setattr(connections, "HEADER_TIMEOUT", 0.3)
    monkeypatch.setattr(connections, "BODY_TIMEOUT", 0.3)
    with half_open(inside.url, sent) as connection:
        assert connection.recv(1000) == b""


@pytest.mark.parametrize("piece", [1 << 20, 60_000, 1000])
def test_a_head_that_is_too_large_is_refused_however_it_arrives(inside: Server, piece: int) -> None:
    head = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"y" * 100_000 + b"\r\n\r\n"
    for _ in range(20):  # how much of it is read at once is up to the kernel
        with half_open(inside.url, b"") as connection, contextlib.suppress(ConnectionError):
            for start in range(0, len(head), piece):
                connection.sendall(head[start : start + piece])
            answer = connection.recv(1 << 16)
            assert answer.startswith(b"HTTP/1.1 400 ") or not answer, answer


def test_slow_sending_does_not_extend_a_connection_s_limit(inside: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HEADER_TIMEOUT", 0.5)
    with half_open(inside.url) as connection:
        connection.settimeout(0.1)
        for _ in range(600):  # the test's patience
            try:
                connection.sendall(b"x")
                if connection.recv(1000) == b"":
                    return
            except TimeoutError:
                continue
            except OSError:
                return
    raise AssertionError("still open")


ANSWER = b"x" * (24 << 20)


async def large(scope: Any, receive: Any, send: Any) -> None:
    """An application whose answer is larger than what the kernel takes at once."""
    if scope["type"] == "http":
        await receive()
        headers = [(b"content-length", str(len(ANSWER)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": ANSWER})


@pytest.fixture
def address_of_large(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, int]]:
    """Where it is served, with very short deadlines."""
    monkeypatch.setattr(connections, "HEADER_TIMEOUT", 0.2)
    monkeypatch.setattr(connections, "_FLUSH_TIMEOUT", 0.5)
    http: Any = partial(Connection, Connections(1024))
    config = uvicorn.Config(large, http=http, lifespan="off", log_level="error", timeout_keep_alive=1)
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        thread.start()
        yield listening.getsockname()
        server.should_exit = True
        thread.join(30)


@pytest.mark.parametrize("another", [False, True], ids=["one", "and begins another request"])
def test_a_slow_reader_gets_all_of_a_large_answer(address_of_large: tuple[str, int], another: bool) -> None:
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 64 << 10)
        connection.settimeout(60)
        connection.connect(address_of_large)
        started = b"GET / HTTP/1.1\r\nHost: x\r\nContent-Le" if another else b""
        connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" + started)
        received = 0
        while received < len(ANSWER):
            piece = connection.recv(256 << 10)
            assert piece, f"cut off after {received} of {len(ANSWER)} bytes"
            received += len(piece)
            time.sleep(0.01)


def test_a_job_has_the_limit_of_open_files_that_the_controller_was_started_with(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = 600 + len(os.listdir("/proc/self/fd"))
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        with serving(tmp_path) as client:
            assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > limit
            job = submit_gang(client, "import resource; print(*resource.getrlimit(resource.RLIMIT_NOFILE))")
            assert next(line["text"] for line in client.logs(job, follow=True)) == f"{limit} {hard}"
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_clients_that_take_no_answer_give_way_or_a_new_one_is_refused(
    inside: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: connections.Connections = inside._uvicorn.config.http.args[0]
    request = b"GET /api/openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    stalled = [half_open(inside.url, request * 200) for _ in range(3)]
    try:
        wait_for(lambda: sum(map(len, held._waiting.values())) >= 3, 60, "that the server can send no more")
        monkeypatch.setattr(held, "most_of_a_peer", held._peers["127.0.0.1"])
        with httpx.Client(base_url=inside.url, timeout=60) as fresh:
            assert fresh.get("/healthz").status_code == 200
        monkeypatch.setattr(held, "most_of_a_peer", 0)
        monkeypatch.setattr(held, "_waiting", {})
        answer = httpx.get(f"{inside.url}/healthz", timeout=60)
        assert answer.status_code == 503 and answer.json()["message"].startswith("too many connections are open")
    finally:
        for connection in stalled:
            connection.close()


# -- answers that are lost --------------------------------------------------------------------------------------------


def lose(patch: pytest.MonkeyPatch, path: str, losses: int) -> list[str]:
    """Throw the first answers to requests for ``path`` away: the server has done it, and the client will never know. Returns them."""
    genuine, lost = httpx.HTTPTransport.handle_request, list[str]()

    def handle(transport: httpx.HTTPTransport, request: httpx.Request) -> httpx.Response:
        answer = genuine(transport, request)
        if request.url.path != path or len(lost) == losses:
            return answer
        lost.append(path)
        answer.close()
        raise httpx.RemoteProtocolError("Server disconnected without sending a response.")

    patch.setattr(httpx.HTTPTransport, "handle_request", handle)
    return lost


def test_a_submission_whose_answer_was_lost_is_submitted_once(
    shared_server: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = shared_server.client.batch
    batch("RegisterJobDefinition", **single("lossy", container()))
    lost = lose(monkeypatch, "/v1/submitjob", 1)
    submitted = batch("SubmitJob", jobName="lossy-once", jobQueue="default", jobDefinition="lossy")
    assert len(lost) == 1
    existing = [{"name": "JOB_NAME", "values": ["lossy-once"]}]
    found = batch("ListJobs", jobQueue="default", filters=existing)["jobSummaryList"]
    assert [job["jobId"] for job in found] == [submitted["jobId"]]


def test_a_log_whose_stream_always_breaks_off_is_given_up_when_the_job_is_over(
    shared_server: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = shared_server.gang("print('never seen')", name="broken-log")
    shared_server.wait(job)
    lost = lose(monkeypatch, f"/api/jobs/{job}/logs", 50)
    with Client(shared_server.url) as client, pytest.raises(Unreachable):
        list(client.logs(job, follow=True))
    assert 0 < len(lost) < 10
