"""HTTPS in front of a controller, by the site of nginx that compose brings; the command's own way in is a Unix socket."""

from __future__ import annotations

import json
import os
import shutil
import socket
import ssl
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from botocore.exceptions import ClientError

from orchestrator import home
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from tests.conftest import REPOSITORY, Serving, call_muster, wait_for
from tests.support.conformance.keys import client
from tests.support.keys import HomeKeys
from tests.support.worker.ranks import free_port

SITE = REPOSITORY / "containers" / "nginx.conf"


@pytest.fixture
def behind(tmp_path: Path) -> Iterator[tuple[Serving, str]]:
    """A controller that demands keys, and the address of nginx in front of it; its certificate is ``tls.pem``."""
    if not shutil.which("nginx"):
        pytest.skip("needs nginx: apt-get install nginx-light")
    port = free_port()
    HomeKeys(tmp_path / "home").create("admin")
    pem, key = tmp_path / "tls.pem", tmp_path / "tls.key"
    subject = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    files = ["-keyout", str(key), "-out", str(pem)]
    subprocess.run(["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", *files, *subject], check=True)
    with Serving(tmp_path / "home", "--trust-proxy", "127.0.0.1") as served:
        site = SITE.read_text().replace("${MUSTER_CONTROLLER}", served.url.removeprefix("http://"))
        (tmp_path / "site").write_text(
            site.replace("listen 443", f"listen {port}").replace("/etc/muster", str(tmp_path))
        )
        own = f"daemon off; pid {tmp_path}/pid; error_log stderr; events {{}}\n"
        own += f"http {{ access_log off; client_body_temp_path {tmp_path}/body; proxy_temp_path {tmp_path}/proxy; include {tmp_path}/site; }}"
        (tmp_path / "nginx.conf").write_text(own)
        proxy = subprocess.Popen(["nginx", "-c", str(tmp_path / "nginx.conf"), "-e", "stderr"])
        try:
            wait_for(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0, 10, "nginx")
            yield served, f"https://localhost:{port}"
        finally:
            proxy.terminate()
            proxy.wait()


def test_signed_requests_and_followed_logs_pass_the_proxy_as_they_were_sent(
    behind: tuple[Serving, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served, url = behind
    key, pem = HomeKeys(served.home).create("ann"), str(tmp_path / "tls.pem")
    token = f"{key.access_key_id}:{key.secret}"
    monkeypatch.setenv("AWS_CA_BUNDLE", pem)
    batch = client(url, key.access_key_id, key.secret)
    assert batch.list_jobs(jobQueue="default")["jobSummaryList"] == []
    with pytest.raises(ClientError, match="InvalidSignatureException"):
        client(url, key.access_key_id, "w" * 40).list_jobs(jobQueue="default")
    with httpx.Client(
        base_url=url, verify=ssl.create_default_context(cafile=pem), headers={"Authorization": f"Bearer {token}"}
    ) as http:
        spec = {"name": "loud", "resources": {"cpus": 0.1}, "command": ["sh", "-c", "echo now; sleep 60"]}
        job = http.post("/api/jobs", json={"spec": spec}).json()["jobId"]
        with http.stream("GET", f"/api/jobs/{job}/logs?follow=true", timeout=30) as log:
            lines = (json.loads(line)["text"] for line in log.iter_lines() if line)
            assert next(lines) == "now"  # while the job runs: nothing is buffered
        assert http.get("/api/jobs").status_code == 200
        batch.terminate_job(jobId=job, reason="seen")


def test_the_command_uses_the_socket_of_its_own_users_controller(
    shared_server: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = shared_server.home / home.SOCKET
    found = path.lstat()
    assert stat.S_ISSOCK(found.st_mode) and stat.S_IMODE(found.st_mode) == 0o600 and found.st_uid == os.geteuid()
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url=shared_server.url) as http:
        assert http.get("/api/capacity").status_code == 200
        assert http.get("/api/capacity", headers={"host": "evil.example"}).status_code == 403
    for name, value in (("MUSTER_HOME", str(shared_server.home)), ("MUSTER_URL", shared_server.url)):
        monkeypatch.setenv(name, value)
        with Client.connect() as connected:
            assert connected._http._transport._pool._uds == str(path)  # type: ignore[attr-defined]
            assert connected.get("/api/capacity")["queues"]


def test_on_the_socket_the_kernel_names_the_caller_and_a_key_is_demanded_where_keys_are(tmp_path: Path) -> None:
    HomeKeys(tmp_path).create("ann")
    with Serving(tmp_path) as served, Client(served.url, socket=home.local_socket(tmp_path)) as unnamed:
        with pytest.raises(ApiError, match="a token is needed"):
            unnamed.get("/api/capacity")
        assert call_muster("list", home=tmp_path).returncode != 0
    assert not (tmp_path / home.SOCKET).exists()


def test_there_is_no_socket_where_another_user_could_replace_it_or_its_path_is_too_long(tmp_path: Path) -> None:
    for name, mode in (("open", 0o777), ("x" * 120, 0o700)):
        (tmp_path / name).mkdir()
        (tmp_path / name).chmod(mode)
        assert home.open_socket(tmp_path / name) is None and home.local_socket(tmp_path / name) is None
    (tmp_path / "open").chmod(0o700)
    listener = home.open_socket(tmp_path / "open")
    assert listener is not None and home.local_socket(tmp_path / "open") is not None
    (tmp_path / "open").chmod(0o777)
    assert home.local_socket(tmp_path / "open") is None  # who waits in it now, is unknown
    listener.close()
