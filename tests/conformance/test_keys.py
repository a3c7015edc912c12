"""Keys: their file and their command, when they are demanded, and what the application learns of who asks."""

from __future__ import annotations

import asyncio
import json
import os
import stat
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from orchestrator.api.auth import Access, Guard
from orchestrator.api.limits import RateLimit
from orchestrator.api.permissions import current_identity
from orchestrator.keys import KeyStore
from tests.conformance.test_security import client, refused
from tests.conftest import Serving, run_muster


def test_the_keys_file_is_its_owners_alone_and_shows_no_secret(tmp_path: Path) -> None:
    created = json.loads(run_muster("keys", "create", "a", "--read-only", "--json", home=tmp_path).stdout)
    assert len(created["accessKeyId"]) == 20 and len(created["secretAccessKey"]) == 40
    path = tmp_path / "keys.json"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    listed = run_muster("keys", "list", "--json", home=tmp_path).stdout
    assert json.loads(listed)[0] == {key: value for key, value in created.items() if key != "secretAccessKey"}
    for text in (listed, run_muster("keys", "list", home=tmp_path).stdout, repr(KeyStore(tmp_path).load())):
        assert created["accessKeyId"] in text and created["secretAccessKey"] not in text
    path.chmod(0o640)
    for command in (["serve", "--port", "0"], ["keys", "list"], ["keys", "create", "b"]):
        done = run_muster(*command, home=tmp_path)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and "chmod 600" in done.stderr, done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["create", "../x"],
        ["create", "a"],
        ["create", "b", "--queue", "arn:x/y z"],
        ["delete", "nobody"],
        ["create", ""],
    ],
)
def test_wrong_uses_of_the_command_end_with_one_line(tmp_path: Path, arguments: list[str]) -> None:
    KeyStore(tmp_path).create("a")
    done = run_muster("keys", *arguments, home=tmp_path)
    assert done.returncode == 1 and done.stderr.startswith("muster: ") and done.stderr.count("\n") == 1, done.stderr
    assert [each.name for each in KeyStore(tmp_path).load().values()] == ["a"]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (b"{", "Invalid JSON"),
        (b"\xff\xfe\x00", "Invalid JSON"),
        (b"[]", "should be an object"),
        (b'{"keys": [{"name": "a"}]}', "keys.0.accessKeyId"),
        (b"", "Invalid JSON"),
    ],
)
def test_a_damaged_keys_file_is_one_line_at_the_start(tmp_path: Path, text: bytes, part: str) -> None:
    (tmp_path / "keys.json").write_bytes(text)
    (tmp_path / "keys.json").chmod(0o600)
    done = run_muster("serve", "--port", "0", home=tmp_path)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert f"{tmp_path}/keys.json: " in done.stderr and part in done.stderr, done.stderr


def test_a_keys_file_damaged_later_leaves_the_last_good_keys_and_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = KeyStore(tmp_path)
    key = store.create("a")
    good = store.path.read_bytes()
    assert list(store.current()) == [key.access_key_id]
    store.path.write_bytes(b"damaged")
    for _ in range(3):
        assert list(store.current()) == [key.access_key_id]
    assert [record.message.count("keys.json") for record in caplog.records] == [1], caplog.text
    assert "until then the 1 keys" in caplog.text and key.secret not in caplog.text
    store.path.write_bytes(good)
    store.delete("a")
    assert store.current() == {}
    assert not Access(store).demanded()
    store.path.write_bytes(b"damaged")
    assert Access(store).demanded()


def test_deleting_the_last_key_opens_nothing(tmp_path: Path) -> None:
    store = KeyStore(tmp_path)
    server = Serving(tmp_path, "--cpus", "1")
    try:
        assert httpx.get(f"{server.url}/api/runs", headers={"Authorization": "AWS4-HMAC-SHA256 x"}).status_code == 200
        client(server.url, "any", "any").list_jobs(jobQueue="default")
        key = store.create("a")
        refused(httpx.get(f"{server.url}/api/runs"), "MissingAuthenticationToken")
        client(server.url, key.access_key_id, key.secret).list_jobs(jobQueue="default")
        store.delete("a")
        refused(httpx.get(f"{server.url}/api/runs"), "MissingAuthenticationToken")
    finally:
        server.close()


def test_off_loopback_a_key_is_demanded_and_other_web_pages_are_refused(tmp_path: Path) -> None:
    done = run_muster("serve", "--host", "0.0.0.0", "--port", "0", home=tmp_path)
    assert done.returncode == 1 and "muster keys create" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    key = KeyStore(tmp_path).create("a")
    server = Serving(tmp_path, "--host", "0.0.0.0", "--cpus", "1")
    try:
        client(server.url, key.access_key_id, key.secret).list_jobs(jobQueue="default")
        bearer = {"Authorization": f"Bearer {key.access_key_id}:{key.secret}"}
        for origin in ("http://evil.example", "null", "http://[", server.url + "0"):
            answer = httpx.get(f"{server.url}/api/runs", headers={**bearer, "Origin": origin})
            refused(answer, "AccessDeniedException", "other web pages")
        assert httpx.get(f"{server.url}/api/runs", headers={**bearer, "Origin": server.url}).status_code == 200
        assert httpx.get(f"{server.url}/api/runs", headers={**bearer, "Host": "muster.example"}).status_code == 200
    finally:
        server.close()


def test_the_rate_counts_each_client_and_submissions_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("orchestrator.api.limits.time.monotonic", lambda: now)
    limit = RateLimit(rate=10, submit_rate=2)
    assert [limit.refusal("a", "submitjob") for _ in range(4)] == [None] * 4
    assert "submit 2 jobs" in str(limit.refusal("a", "submitjob"))
    assert [limit.refusal("a", "listjobs") for _ in range(15)] == [None] * 15
    assert "10 requests" in str(limit.refusal("a", "listjobs"))
    assert limit.refusal("b", "submitjob") is None
    now = 101.0
    assert [bool(limit.refusal("a", "listjobs")) for _ in range(12)] == [False] * 10 + [True] * 2
    now = 150.0
    limit.refusal("c", "")
    assert len(limit._buckets) == 1
    assert not any(RateLimit(rate=0).refusal("a", "submitjob") for _ in range(5000))


def test_the_application_sees_who_asks(tmp_path: Path) -> None:
    key = KeyStore(tmp_path).create("a", ("robots",), read_only=True)

    def who(request: Request) -> JSONResponse:  # in another thread, as all our operations are
        identity = current_identity.get()
        assert request.state.identity is identity
        return JSONResponse([identity.name, sorted(identity.queues or ()), identity.read_only])

    inner = Starlette(routes=[Route("/", who)])

    async def ask(access: Access, token: str) -> Any:
        transport = httpx.ASGITransport(Guard(inner, access, RateLimit()))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
            return (await http.get("/", headers={"Authorization": f"Bearer {token}"})).json()

    access = Access(KeyStore(tmp_path), "the-token")
    assert asyncio.run(ask(access, f"{key.access_key_id}:{key.secret}")) == ["key a", ["robots"], True]
    assert asyncio.run(ask(access, "the-token")) == ["MUSTER_TOKEN", [], False]
    assert asyncio.run(ask(access, access.own_token)) == ["this process", [], False]
    assert asyncio.run(ask(Access(), "any")) == ["address 127.0.0.1", [], False]
    assert current_identity.get().name == "this process"


def test_muster_run_gets_into_the_controller_that_it_brings(tmp_path: Path) -> None:
    KeyStore(tmp_path).create("a")
    spec = tmp_path / "job.yaml"
    spec.write_text("name: own\nresources: {cpus: 0.1}\ncommand: ['true']\n")
    assert "MUSTER_TOKEN" not in os.environ
    done = run_muster("run", str(spec), home=tmp_path)
    assert done.returncode == 0, done.stderr
