"""The client against a network that loses answers: a real proxy between it and a real server."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest

from orchestrator.client import Client
from orchestrator.domain.errors import Unreachable
from tests.conftest import Serving, submit_gang, wait_for


class LossyProxy:
    """Forwards connections to a server; the first ``losses`` answers to requests that hold ``marker`` are thrown away."""

    def __init__(self, url: str, marker: bytes, losses: int = 1) -> None:
        parts = urlsplit(url)
        self._target, self._marker, self.lost = (parts.hostname, parts.port), marker, 0
        self._losses = losses
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._carry, args=(client,), daemon=True).start()

    def _carry(self, client: socket.socket) -> None:
        with client, socket.create_connection(self._target) as server:
            while request := _message(client):
                server.sendall(request)
                answer = _message(server)
                if self._marker in request and self.lost < self._losses:
                    self.lost += 1
                    return  # the server has done it, and the client will never know
                client.sendall(answer)


def _message(connection: socket.socket) -> bytes:
    """One whole HTTP message; empty where the other side has closed."""
    text = b""
    while b"\r\n\r\n" not in text:
        if not (part := connection.recv(1 << 16)):
            return b""
        text += part
    head, _, body = text.partition(b"\r\n\r\n")
    length = re.search(rb"content-length: (\d+)", head, re.IGNORECASE)
    while len(body) < (int(length[1]) if length else 0):
        body += connection.recv(1 << 16)
    return head + b"\r\n\r\n" + body


@pytest.fixture
def proxy(shared_server: Serving) -> Iterator[LossyProxy]:
    proxy = LossyProxy(shared_server.url, b"/v1/submitjob")
    yield proxy
    proxy.close()


def test_a_submission_whose_answer_was_lost_is_submitted_once(shared_server: Serving, proxy: LossyProxy) -> None:
    needs = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}]
    container = {"image": "x", "command": ["true"], "resourceRequirements": needs}
    shared_server.client.batch(
        "RegisterJobDefinition", jobDefinitionName="lossy", type="container", containerProperties=container
    )
    with Client(proxy.url) as client:
        submitted = client.batch("SubmitJob", jobName="lossy-once", jobQueue="default", jobDefinition="lossy")
    assert proxy.lost == 1
    there = [{"name": "JOB_NAME", "values": ["lossy-once"]}]
    found = shared_server.client.batch("ListJobs", jobQueue="default", filters=there)["jobSummaryList"]
    assert [job["jobId"] for job in found] == [submitted["jobId"]]


def test_a_log_whose_stream_always_breaks_off_is_given_up_when_the_job_is_over(shared_server: Serving) -> None:
    job = submit_gang(shared_server.client, "print('never seen')", name="broken-log")
    shared_server.client.batch("TerminateJob", jobId=job, reason="enough")
    wait_for(lambda: shared_server.client.get(f"/api/jobs/{job}")["status"] in ("FAILED", "SUCCEEDED"), 60, "its end")
    proxy = LossyProxy(shared_server.url, b"/logs?", losses=50)
    try:
        with Client(proxy.url) as client, pytest.raises(Unreachable):
            list(client.logs(job, follow=True))
    finally:
        proxy.close()
    assert proxy.lost < 10
