"""Keys and secrets in the database: a home of an older Muster, a machine after another, and a second process beside a controller."""

from __future__ import annotations

import hmac
import json
import shutil
import socket
from hashlib import sha256
from pathlib import Path

import httpx
import pytest

from orchestrator.cli.keys import opened
from orchestrator.persistence.access_keys import KeysError
from orchestrator.persistence.own_secrets import BUS_KEY, BUS_PORT
from tests.conftest import Serving, call_muster
from tests.support.console.visitor import Page, Visitor
from tests.support.keys import HomeKeys, secret_of_home

KEYS = [
    {"name": "ann-2", "accessKeyId": "MSTR234567ABCDEFGHIJ", "secret": "a-secret-of-ann-that-was-in-a-file"},
    {"name": "wall", "accessKeyId": "MSTR765432ABCDEFGHIJ", "secret": "a-secret-of-the-wall-in-a-file"},
]
KEYS[0] |= {"queues": None, "readOnly": False, "createdAt": 1}
KEYS[1] |= {"queues": ["robots"], "readOnly": True, "createdAt": 2}
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
        ("keys.json", b"\xff\xfe\x00", "Invalid JSON"),
        ("keys.json", b'{"keys": [{"name": "a"}]}', "keys.0.accessKeyId"),
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
