"""Who is at the other end of a connection over loopback, where no key is demanded."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys

import pytest

from orchestrator.api.http.callers import Caller
from tests.conftest import PATIENCE, Serving
from tests.support.conformance.streams import client_of

NOBODY = 65534
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user, too")


def uid(client: socket.socket, server: socket.socket) -> int | None:
    return asyncio.run(Caller(client.getsockname()[:2], server.getsockname()[:2]).uid())


@pytest.mark.parametrize(
    ("family", "own", "reached"),
    [
        (socket.AF_INET, "127.0.0.1", "127.0.0.1"),
        (socket.AF_INET6, "::1", "::1"),
        (socket.AF_INET6, "::ffff:127.0.0.1", "127.0.0.1"),
    ],
)
def test_the_user_of_a_connection_is_found_in_the_kernels_table(family: int, own: str, reached: str) -> None:
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        listener.bind((own, 0))
        listener.listen()
        with socket.create_connection((reached, listener.getsockname()[1])) as client:
            server, _ = listener.accept()
            with server:
                assert uid(client, server) == os.getuid()
                assert uid(server, client) == os.getuid()
                caller = Caller(client.getsockname()[:2], server.getsockname()[:2])
                other = Caller(("127.0.0.1", 1), server.getsockname()[:2])
                assert asyncio.run(caller.uid()) == os.getuid() and asyncio.run(other.uid()) is None
                client.shutdown(socket.SHUT_WR)
                assert uid(client, server) == os.getuid()
                ends = client.getsockname()[:2], server.getsockname()[:2]
                client.close()
                assert asyncio.run(Caller(*ends).uid()) is None  # the table shows what is left of it as root's
                assert asyncio.run(caller.uid()) == os.getuid()  # looked up once


def as_nobody(script: str, *arguments: str) -> str:
    """Run Python as another user, who need not be able to read this interpreter's files."""
    become = f"import encodings.idna, http.client, os, socket, sys; os.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY})\n"
    done = subprocess.run(
        [sys.executable, "-c", become + script, *arguments], capture_output=True, text=True, timeout=60 * PATIENCE
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@as_root
def test_another_user_of_the_machine_is_told_to_ask_for_a_key(shared_server: Serving) -> None:
    client_of(shared_server.url, "batch").list_jobs(jobQueue="default")  # the own user, with any credentials
    script = """
connection = http.client.HTTPConnection(sys.argv[1])
for method, path in (("GET", "/api/runs"), ("POST", "/v1/listjobs"), ("GET", "/healthz")):
    connection.request(method, path, headers={"Authorization": "AWS4-HMAC-SHA256 Credential=x"})
    answer = connection.getresponse()
    print(answer.status, answer.read().decode())
"""
    first, second, health = as_nobody(script, shared_server.url.removeprefix("http://")).splitlines()
    for line in (first, second):
        assert line.startswith('403 {"__type":"AccessDeniedException"') and "ask root for a key" in line, line
    assert health.startswith("200 ")


def test_files_with_secrets_are_private_and_jobs_keep_the_users_umask(shared_server: Serving) -> None:
    made = shared_server.home / "made by a job"
    job = shared_server.gang(f"open({str(made)!r}, 'w')")
    shared_server.wait(job, "SUCCEEDED")
    private = ("muster.db", "muster.db-wal", "bus.json", "store", "supervisors")
    open_to_others = [name for name in private if (shared_server.home / name).stat().st_mode & 0o077]
    assert open_to_others == []
    before = os.umask(0)
    os.umask(before)
    assert made.stat().st_mode & 0o777 == 0o666 & ~before


def test_the_server_prints_at_its_start_who_may_connect(shared_server: Serving) -> None:
    assert shared_server.process.stdout is not None
    assert "without a key; `muster keys create NAME` lets others in" in shared_server.process.stdout.readline()
