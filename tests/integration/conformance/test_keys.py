"""Keys: their command and their database, when they are demanded, what the application learns of who asks, and who that is where no key is demanded."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import stat
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from botocore.exceptions import ClientError

from orchestrator.api.http.callers import Caller
from orchestrator.api.http.limits import RateLimit
from orchestrator.domain.errors import ServerError
from orchestrator.home import HomeLock
from orchestrator.persistence.batch_models import JobQueue
from orchestrator.persistence.session import Database
from orchestrator.server import Server
from tests.conftest import PATIENCE, Serving, call_muster, run_muster, wait_for
from tests.support.conformance.keys import client, refused
from tests.support.conformance.streams import client_of
from tests.support.keys import HomeKeys


def test_the_command_shows_a_secret_once_and_the_home_keeps_it_sealed(tmp_path: Path) -> None:
    created = json.loads(call_muster("keys", "create", "a-b", "--read-only", "--json", home=tmp_path).stdout)
    assert len(created["accessKeyId"]) == 20 and len(created["secretAccessKey"]) == 40 and created["share"] == "ab"
    path = tmp_path / "sealing.key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    listed = call_muster("keys", "list", "--json", home=tmp_path).stdout
    assert json.loads(listed)[0] == {key: value for key, value in created.items() if key != "secretAccessKey"}
    for text in (listed, call_muster("keys", "list", home=tmp_path).stdout, repr(HomeKeys(tmp_path).load())):
        assert created["accessKeyId"] in text and created["secretAccessKey"] not in text
    found = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert not [file for file in found if created["secretAccessKey"].encode() in file.read_bytes()]
    path.chmod(0o640)
    for command in (["serve", "--port", "0"], ["keys", "list"], ["keys", "create", "b"]):
        done = call_muster(*command, home=tmp_path)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and "chmod 600" in done.stderr, done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["create", "../x"],
        ["create", "a"],
        ["create", "b", "--queue", "arn:x/y z"],
        ["create", "b", "--share", "a-b"],
        ["delete", "nobody"],
        ["create", ""],
    ],
)
def test_wrong_uses_of_the_command_end_with_one_line(tmp_path: Path, arguments: list[str]) -> None:
    HomeKeys(tmp_path).create("a")
    done = call_muster("keys", *arguments, home=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("muster: ") and done.stderr.count("\n") == 1, done.stderr
    assert [each.name for each in HomeKeys(tmp_path).load().values()] == ["a"]


def test_the_database_of_the_keys_is_the_one_that_the_controller_is_given(tmp_path: Path) -> None:
    elsewhere = f"{tmp_path}/other.db"
    assert call_muster("keys", "create", "before", "--database", elsewhere, home=tmp_path).returncode == 0
    with Serving(tmp_path, "--cpus", "1", "--database", elsewhere):
        wrong = call_muster("keys", "create", "a", home=tmp_path)
        assert wrong.returncode == 2 and f"has its keys in sqlite:///{elsewhere}" in wrong.stderr, wrong.stderr
        assert call_muster("keys", "create", "a", "--database", elsewhere, home=tmp_path).returncode == 0
        listed = call_muster("keys", "list", "--json", home=tmp_path, MUSTER_DATABASE=elsewhere).stdout
    assert [each["name"] for each in json.loads(listed)] == ["before", "a"] and not (tmp_path / "muster.db").exists()


def test_keys_come_and_go_without_a_restart_and_deleting_the_last_one_opens_nothing(tmp_path: Path) -> None:
    store = HomeKeys(tmp_path)

    def is_refused(url: str) -> bool:
        return httpx.get(f"{url}/api/runs").status_code == 403

    with Serving(tmp_path, "--cpus", "1") as server:
        assert httpx.get(f"{server.url}/api/runs", headers={"Authorization": "AWS4-HMAC-SHA256 x"}).status_code == 200
        client(server.url, "any", "any").list_jobs(jobQueue="default")
        key = store.create("a")
        wait_for(lambda: is_refused(server.url), what="the server's look at the keys")
        refused(httpx.get(f"{server.url}/api/runs"), "MissingAuthenticationToken")
        client(server.url, key.access_key_id, key.secret).list_jobs(jobQueue="default")
        again = call_muster("list", home=tmp_path)
        assert again.returncode == 1 and "`muster keys list` shows the keys" in again.stderr
        assert call_muster("keys", "create", "c", home=tmp_path / "other").stdout.startswith(
            "from now on everybody needs"
        )
        made = call_muster("keys", "create", "b", "--queue", "robots", "--queue", "default", home=tmp_path)
        other = next(each for each in store.load().values() if each.name == "b")
        assert other.queues == ("robots", "default") and made.returncode == 0, made.stderr
        assert f"export MUSTER_TOKEN={other.access_key_id}:{other.secret}" in made.stdout
        client(server.url, other.access_key_id, other.secret).list_jobs(jobQueue="default")
        assert call_muster("keys", "delete", "b", home=tmp_path).returncode == 0
        done = call_muster("keys", "delete", "a", home=tmp_path)
        assert "deleted key a\nthis was the last key" in done.stdout, done.stdout
        assert "its own user's requests on loopback" in done.stdout and "does not start without a key" in done.stdout
        refused(httpx.get(f"{server.url}/api/runs"), "MissingAuthenticationToken")
        left = "this controller has no key: on its machine"
        wait_for(lambda: left in call_muster("list", home=tmp_path).stderr, what="the server's look at the keys")
        for each in (other, key):
            bearer = {"Authorization": f"Bearer {each.access_key_id}:{each.secret}"}
            wait_for(lambda sent=bearer: httpx.get(f"{server.url}/api/runs", headers=sent).status_code == 403)
            with pytest.raises(ClientError, match="UnrecognizedClientException"):
                client(server.url, each.access_key_id, each.secret).list_jobs(jobQueue="default")


def test_off_loopback_a_key_is_demanded_and_other_web_pages_are_refused(tmp_path: Path) -> None:
    done = call_muster("serve", "--host", "0.0.0.0", "--port", "0", home=tmp_path)
    assert done.returncode == 1 and "muster keys create" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    key = HomeKeys(tmp_path).create("a")
    with Serving(tmp_path, "--host", "0.0.0.0", "--cpus", "1") as server:
        client(server.url, key.access_key_id, key.secret).list_jobs(jobQueue="default")
        bearer = {"Authorization": f"Bearer {key.access_key_id}:{key.secret}"}
        for origin in ("http://evil.example", "null", "http://[", server.url + "0"):
            answer = httpx.get(f"{server.url}/api/runs", headers={**bearer, "Origin": origin})
            refused(answer, "AccessDeniedException", "other web pages")
        assert httpx.get(f"{server.url}/api/runs", headers={**bearer, "Origin": server.url}).status_code == 200
        assert httpx.get(f"{server.url}/api/runs", headers={**bearer, "Host": "muster.example"}).status_code == 200


def test_the_rate_counts_each_client_and_submissions_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("orchestrator.api.http.limits.time.monotonic", lambda: now)
    limit = RateLimit(rate=10, submit_rate=2)
    assert [limit.refusal("a", "submitjob") for _ in range(4)] == [None] * 4
    assert "submit 2 jobs" in str(limit.refusal("a", "submitjob"))
    assert [limit.refusal("a", "listjobs") for _ in range(15)] == [None] * 15
    assert "10 requests" in str(limit.refusal("a", "listjobs"))
    assert limit.refusal("b", "submitjob") is None
    now = 101.0
    assert [bool(limit.refusal("a", "listjobs")) for _ in range(12)] == [False] * 10 + [True] * 2
    failed = [limit.refusal_of_failures("10.0.0.1") for _ in range(150)]
    assert failed[:100] == [None] * 100 and "wrong token" in str(failed[100])  # whatever the rate for right ones is
    assert limit.refusal_of_failures("10.0.0.2") is None
    now = 150.0
    limit.refusal("c", "")
    assert len(limit._buckets) == 1
    assert not any(RateLimit(rate=0).refusal("a", "submitjob") for _ in range(5000))


def test_a_token_or_a_proxy_that_is_not_safe_is_refused_at_the_start(tmp_path: Path) -> None:
    for token in ("x", "fifteen-letters", "abababababababababababab"):
        with pytest.raises(ServerError, match="MUSTER_TOKEN is too easy to guess: use at least 16 characters"):
            Server(tmp_path, token=token)
    assert list(tmp_path.iterdir()) == []
    for proxy, output in (
        ("proxy", "'proxy' does not appear"),
        ("127.0.0.1", "the server is reachable from other machines: first create a key"),
    ):
        with pytest.raises(ServerError, match=f"--trust-proxy: {output}"):
            Server(tmp_path, trusted_proxies=[proxy])
    key = HomeKeys(tmp_path).create("wall", read_only=True)
    with pytest.raises(ServerError, match=f"MUSTER_TOKEN is the key {key.access_key_id} of a client"):
        Server(tmp_path, token=f"{key.access_key_id}:{key.secret}")


def test_a_home_is_its_users_alone_and_an_open_one_is_closed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = os.umask(0o022)
    try:
        HomeLock(tmp_path / "new").release()
        assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o700 and not caplog.records
        for name in ("older", "shared"):
            (tmp_path / name).mkdir(mode=0o755)
        (tmp_path / "older" / "controller.lock").touch()
        (tmp_path / "older" / "muster.db").touch(mode=0o644)
        (tmp_path / "shared" / "of another").touch()
        for name, mode, words in (("older", 0o700, "it is closed to them now"), ("shared", 0o755, "run chmod 700")):
            HomeLock(tmp_path / name).release()
            assert stat.S_IMODE((tmp_path / name).stat().st_mode) == mode
            [record] = caplog.records
            assert words in record.message and str(tmp_path / name) in record.message
            caplog.clear()
        (tmp_path / "elsewhere").mkdir(mode=0o755)
        for name in ("store", "ray"):
            (tmp_path / "shared" / name).mkdir(mode=0o755)
        (tmp_path / "shared" / "kernels").rmdir()
        (tmp_path / "shared" / "kernels").symlink_to(tmp_path / "elsewhere")
        HomeLock(tmp_path / "shared").release()
        modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "shared").iterdir()}
        assert {name: modes[name] for name in ("store", "ray", "supervisors", "kernels", "of another")} == {
            **dict.fromkeys(("store", "ray", "supervisors"), 0o700),
            "kernels": 0o755,  # it lies elsewhere, and may be shared
            "of another": 0o644,
        }
        output = caplog.records[0].message
        assert "since it also holds 'of another'" in output and "Muster's directories in it are closed" in output
        database = Database.at(tmp_path / "older")
        with database.session() as session:
            session.add(JobQueue(name="x", compute_environments=[]))
        found = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "older").glob("muster.db*")}
        database.close()
        assert found == dict.fromkeys(("muster.db", "muster.db-wal", "muster.db-shm", "muster.db.lock"), 0o600)
    finally:
        os.umask(before)


def test_muster_run_gets_into_the_controller_that_it_brings(tmp_path: Path) -> None:
    HomeKeys(tmp_path).create("a")
    spec = tmp_path / "job.yaml"
    spec.write_text("name: own\nresources: {cpus: 0.1}\ncommand: ['true']\n")
    assert "MUSTER_TOKEN" not in os.environ
    done = run_muster("run", str(spec), home=tmp_path)
    assert done.returncode == 0, done.stderr


# -- the user at the other end of a connection over loopback -----------------------------------------------------------


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
def test_another_user_of_the_machine_is_advised_to_ask_for_a_key(shared_server: Serving) -> None:
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
    private = ("muster.db", "muster.db-wal", "sealing.key", "bus-users", "store", "supervisors")
    open_to_others = [name for name in private if (shared_server.home / name).stat().st_mode & 0o077]
    assert open_to_others == []
    before = os.umask(0)
    os.umask(before)
    assert made.stat().st_mode & 0o777 == 0o666 & ~before


def test_the_server_prints_at_its_start_who_may_connect(shared_server: Serving) -> None:
    assert shared_server.process.stdout is not None
    assert "without a key; `muster keys create NAME` lets others in" in shared_server.process.stdout.readline()
