"""Keys and secrets in the database: a home of an older Muster, a machine after another, and a second process beside a controller."""

from __future__ import annotations

import contextlib
import hmac
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import httpx
import pytest

from orchestrator.cli.keys import opened
from orchestrator.persistence.access_keys import KeysError
from orchestrator.persistence.own_secrets import BUS_KEY, BUS_PORT
from tests.conftest import PATIENCE, REPOSITORY, Serving, call_muster
from tests.support.console.visitor import Page, Visitor
from tests.support.keys import HomeKeys, secret_of_home
from tests.support.waiting import wait_for

KEYS = [
    {
        "name": "ann-2",
        "accessKeyId": "MSTR234567ABCDEFGHIJ",
        "secret": "a-secret-of-ann-that-was-in-a-file",
        "queues": None,
        "readOnly": False,
        "createdAt": 1,
    },
    {
        "name": "wall",
        "accessKeyId": "MSTR765432ABCDEFGHIJ",
        "secret": "a-secret-of-the-wall-in-a-file",
        "queues": ["robots"],
        "readOnly": True,
        "createdAt": 2,
    },
]
MASTER, SESSIONS = "5a" * 32, bytes(range(32))
FILES = ("keys.json", "bus.json", "console.secret")


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """The files of a home directory from before they were in the database."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    contents = json.dumps({"keys": KEYS}), json.dumps({"key": MASTER, "port": port}), SESSIONS
    for name, content in zip(FILES, contents, strict=True):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        path.chmod(0o600)
    (tmp_path / "keys.lock").touch()
    return tmp_path


def bearer(key: dict[str, str]) -> dict[str, str]:
    return {"Authorization": f"Bearer {key['accessKeyId']}:{key['secret']}"}


def test_an_older_home_moves_into_the_database_at_its_first_start(older: Path) -> None:
    port = json.loads((older / "bus.json").read_text())["port"]
    with Serving(older, "--cpus", "1") as server:
        assert [httpx.get(f"{server.url}/api/queues", headers=bearer(key)).status_code for key in KEYS] == [200, 200]
        assert httpx.get(f"{server.url}/api/runs").status_code == 403
        listed = httpx.get(f"{server.url}/api/keys", headers=bearer(KEYS[0])).json()
        assert listed == [
            {**{name: value for name, value in key.items() if name != "secret"}, "share": share}
            for key, share in zip(KEYS, ("ann2", "wall"), strict=True)
        ]
        token = Page(httpx.get(f"{server.url}/login").text).form_token
        assert token == hmac.new(SESSIONS, b"form\0", sha256).hexdigest(), "open pages of the console go on"
        assert (secret_of_home(older, BUS_KEY), secret_of_home(older, BUS_PORT)) == (MASTER, str(port))
        socket.create_connection(("127.0.0.1", port)).close()
        text = b"".join(path.read_bytes() for path in older.glob("muster.db*"))
    for secret in (*(key["secret"] for key in KEYS), MASTER, SESSIONS.hex()):
        assert str(secret).encode() not in text
    assert SESSIONS not in text
    assert not [name for name in (*FILES, "keys.lock") if (older / name).exists()]
    assert [(older / f"{name}.migrated").stat().st_mode & 0o777 for name in FILES] == [0o600] * 3


def test_the_command_moves_an_older_home_too(older: Path) -> None:
    listed = json.loads(call_muster("keys", "list", "--json", home=older).stdout)
    assert [(each["name"], each["share"]) for each in listed] == [("ann-2", "ann2"), ("wall", "wall")]
    assert call_muster("keys", "delete", "wall", home=older).returncode == 0
    assert [key.name for key in HomeKeys(older).load().values()] == ["ann-2"]


@pytest.mark.parametrize("renamed", range(4))
def test_a_start_that_is_killed_meanwhile_loses_nothing(
    older: Path, renamed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        """Nothing after it is done."""

    rename, done = Path.rename, []

    def until_killed(self: Path, target: Path) -> Path:
        if len(done) == renamed - 1:
            raise Killed
        done.append(self.name)
        return rename(self, target)

    def killed(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        if renamed:
            patch.setattr(Path, "rename", until_killed)
        else:  # in the transaction
            patch.setattr("orchestrator.persistence.own_secrets.OwnSecrets.put", killed)
        with pytest.raises(Killed), opened(older):
            pass
    left = [name for name in FILES if (older / name).exists()]
    assert left == [name for name in FILES if name not in done]
    with opened(older) as keys:
        assert [(key.name, key.secret) for key in keys.current().values()] == [(k["name"], k["secret"]) for k in KEYS]
    assert secret_of_home(older, BUS_KEY) == MASTER
    assert not [name for name in FILES if (older / name).exists()]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("keys.json", b"{", "Invalid JSON"),
        ("keys.json", b"\xff\xfe\x00", "Invalid JSON"),
        ("keys.json", b"[]", "should be an object"),
        ("keys.json", b'{"keys": [{"name": "a"}]}', "keys.0.accessKeyId"),
        ("bus.json", b"damaged", "nodes that run now take no commands"),
        ("bus.json", b"{}", "has no key or no port"),
        ("console.secret", b"short", "has 5 bytes and not 32"),
    ],
)
def test_a_damaged_file_is_one_line_and_nothing_of_the_home_changes(
    older: Path, name: str, content: bytes, words: str
) -> None:
    (older / name).write_bytes(content)
    done = call_muster("serve", "--port", "0", home=older)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert f"{older}/{name}: " in done.stderr and words in done.stderr, done.stderr
    assert all((older / each).exists() for each in FILES)


def test_keys_that_others_could_read_and_a_name_of_two_keys_are_refused(older: Path) -> None:
    (older / "keys.json").chmod(0o640)
    done = call_muster("keys", "list", home=older)
    assert done.returncode == 1 and "chmod 600" in done.stderr, done.stderr
    (older / "keys.json").chmod(0o600)
    with opened(older):
        pass
    other = {**KEYS[0], "accessKeyId": "MSTRABCDEF234567ABCD"}
    (older / "keys.json").write_text(json.dumps({"keys": [other, KEYS[1]]}))
    (older / "keys.json").chmod(0o600)
    with (
        pytest.raises(KeysError, match="there is another key ann-2 already; give this one another name"),
        opened(older),
    ):
        pass


def test_another_machine_goes_on_with_the_database_and_a_copy_of_the_sealing_key(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    common = "--cpus", "1", "--database", f"{tmp_path}/common.db", "--store", f"{tmp_path}/store"
    with Serving(first, *common) as server:
        key = httpx.post(f"{server.url}/api/keys", json={"name": "ann"}).json()
        visitor = Visitor(server.url, f"{key['accessKeyId']}:{key['secretAccessKey']}")
        (session,) = visitor.http.cookies.values()
        token = visitor.page("/").form_token
        visitor.http.close()
    without = call_muster("serve", *common, "--port", "0", home=second)
    assert without.returncode == 1 and without.stderr.count("\n") == 1, without.stderr
    assert f"{second}/sealing.key: missing" in without.stderr and not (second / "sealing.key").exists()
    (second / "sealing.key").write_bytes(b"4" * 43 + b"=")
    (second / "sealing.key").chmod(0o600)
    wrong = call_muster("keys", "list", "--database", common[3], home=second)
    assert wrong.returncode == 1 and f"{second}/sealing.key: does not open the secrets in the database" in wrong.stderr
    shutil.copy2(first / "sealing.key", second / "sealing.key")
    with Serving(second, *common) as server:
        cookies = {f"muster-session-{server.url.rpartition(':')[2]}": session}
        page = httpx.get(f"{server.url}/", headers={"Accept": "text/html"}, cookies=cookies)
        assert page.status_code == 200 and Page(page.text).form_token == token


SECOND = """
import sys
from pathlib import Path
import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from orchestrator.api.http.access import Access
from orchestrator.api.http.auth import Guard
from orchestrator.api.http.limits import RateLimit
from orchestrator.persistence.access_keys import KeyStore
from orchestrator.persistence.own_secrets import CONSOLE, OwnSecrets
from orchestrator.persistence.session import Database

database = Database.at(Path(sys.argv[1]), beside=True)
own = OwnSecrets(database, Path(sys.argv[1]))
keys = KeyStore(own)
keys.start()
access = Access(keys, console_secret=bytes.fromhex(own.get(CONSOLE)))
inner = Starlette(routes=[Route("/{path:path}", lambda request: PlainTextResponse(request.scope["state"]["actor"].name))])
uvicorn.run(Guard(inner, access, RateLimit(0)), port=int(sys.argv[2]), log_level="warning")
"""
"""A process that serves the keys and sessions of a home directory beside its controller."""


@contextlib.contextmanager
def second_process(home: Path) -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen([sys.executable, "-c", SECOND, str(home), str(port)], cwd=REPOSITORY)
    url = f"http://127.0.0.1:{port}"

    def answers() -> bool:
        with contextlib.suppress(httpx.HTTPError):
            return httpx.get(f"{url}/healthz").status_code == 200
        return False

    try:
        wait_for(answers, 20 * PATIENCE, "the second process")
        yield url
    finally:
        process.kill()
        process.wait()


def test_a_second_process_serves_the_same_keys_and_sessions(tmp_path: Path) -> None:
    with Serving(tmp_path, "--cpus", "1") as server:
        made = httpx.post(f"{server.url}/api/keys", json={"name": "ann"}).json()
        with second_process(tmp_path) as other:

            def answer(url: str, key: dict[str, str]) -> httpx.Response:
                return httpx.get(f"{url}/api/runs", headers=bearer({**key, "secret": key["secretAccessKey"]}))

            assert answer(other, made).text == "key ann"
            http = httpx.Client(headers=bearer({**made, "secret": made["secretAccessKey"]}))
            for name in ("bob", "carl"):
                new = http.post(f"{server.url}/api/keys", json={"name": name, "share": "lab"}).json()
                assert answer(other, new).text == f"key {name}", "an unknown key is looked for at once"
            visitor = Visitor(server.url, f"{new['accessKeyId']}:{new['secretAccessKey']}")
            (session,) = visitor.http.cookies.values()
            visitor.http.close()
            cookies = {f"muster-session-{other.rpartition(':')[2]}": session}
            assert httpx.get(f"{other}/", cookies=cookies).text == "key carl"
            http.delete(f"{server.url}/api/keys/carl").raise_for_status()
            assert answer(server.url, new).status_code == 403, "at once where it was deleted"
            wait_for(lambda: answer(other, new).status_code == 403, what="the other's look")
            assert httpx.get(f"{other}/", cookies=cookies).status_code == 403
            assert answer(other, made).status_code == 200
            http.close()


def test_a_running_node_takes_commands_of_the_next_controller(tmp_path: Path) -> None:
    with Serving(tmp_path, "--cpus", "1") as server:
        job = server.gang("import time; time.sleep(600)")
        server.wait(job, "RUNNING")
        before = secret_of_home(tmp_path, BUS_KEY), secret_of_home(tmp_path, BUS_PORT)
        server.kill()
        server.start()
        assert (secret_of_home(tmp_path, BUS_KEY), secret_of_home(tmp_path, BUS_PORT)) == before
        wait_for(lambda: server.muster("stacks", job).returncode == 0, 30 * PATIENCE, "an answer of the node")
        assert server.muster("stop", job).returncode == 0
