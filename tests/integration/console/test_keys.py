"""The page of keys, through real servers: on loopback, and one that other machines can reach."""

from __future__ import annotations

import contextlib
from pathlib import Path

import httpx
import pytest

from orchestrator.keys import KeyStore
from tests.conftest import Serving
from tests.support.console.fixtures import Console, secret_of
from tests.support.console.visitor import Page, Visitor


def post(visitor: Visitor, path: str, **fields: str | list[str]) -> httpx.Response:
    """Send a form of the page as a browser without scripts does."""
    return visitor.http.post(path, data={"form_token": visitor.page("/keys").form_token, **fields})


def test_the_list_tells_what_each_key_may_do_and_no_secret(console: Console) -> None:
    page = console.visitor().page("/keys")
    for text in ("admin you", "all queues, read only", "queues lab, read and write"):
        assert text in page.text
    assert not any(secret.partition(":")[2] in page.source for secret in console.secrets.values())
    assert [each["name"] for each in console.client.get("/api/keys")] == ["admin", "lab", "reader"]
    assert "secret" not in str(console.client.get("/api/keys")).lower()


def test_a_key_is_made_its_secret_is_shown_once_and_it_works(console: Console) -> None:
    answer = post(console.visitor(), "/keys/create", name="alice", queue=["lab", "default"], read_only="yes")
    (key,) = [key for key in console.keys.load().values() if key.name == "alice"]
    assert (key.queues, key.read_only) == (("lab", "default"), True)
    assert answer.status_code == 200 and f"MUSTER_TOKEN={secret_of(key)}" in answer.text
    assert answer.headers["cache-control"] == "no-store"
    alice = Visitor(console.url, secret_of(key))
    assert "key alice" in alice.page("/").text
    alice.close()
    assert key.secret not in console.visitor().page("/keys").source
    again = post(console.visitor(), "/keys/create", name="alice")
    assert again.status_code == 400 and "there is a key alice already" in Page(again.text).text


def test_a_key_is_deleted_once_the_person_has_said_yes(console: Console) -> None:
    key = console.keys.create("bob")
    bob, visitor = Visitor(console.url, secret_of(key)), console.visitor()
    stream = visitor.events("/keys/stream")
    assert "bob" in next(stream)[1]["order"]
    asked = visitor.submit("/keys/delete", name="bob")
    assert asked.status_code == 409 and asked.json()["question"]["title"] == "Delete key bob?"
    assert bob.http.get("/", follow_redirects=False).status_code == 200
    told = visitor.submit("/keys/delete", name="bob", confirmed="yes").json()
    assert told == {"location": "/keys", "message": "deleted key bob"}
    assert "bob" not in next(stream)[1]["order"]
    stream.close()
    assert bob.http.get("/", follow_redirects=False).status_code == 303
    bob.close()
    assert "there is no key 'bob'" in visitor.submit("/keys/delete", name="bob", confirmed="yes").json()["message"]
    own = visitor.submit("/keys/delete", name="admin").json()["question"]["text"]
    assert "It is your own: you are logged out." in own and "last one" not in own


def test_only_keys_with_all_queues_see_keys_and_a_read_only_one_changes_none(console: Console) -> None:
    lab, reader = console.visitor("lab"), console.visitor("reader")
    assert "may use job queue lab only" in lab.page("/keys", 403).text
    for visitor, said in ((lab, "may use job queue lab only"), (reader, "is read-only")):
        made = visitor.submit("/keys/create", name="mine")
        gone = visitor.submit("/keys/delete", name="admin", confirmed="yes")
        for answer in (made, gone):
            assert answer.status_code == 403 and said in answer.json()["message"]
    page = reader.page("/keys")
    assert "admin" in page.text and [each["action"] for each in page.all("form", method="post")] == ["/logout"]
    assert {key.name for key in console.keys.load().values()} >= {"admin", "lab", "reader"}


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "", '" onload="x', "a/b", "../x", "x" * 200])
def test_a_hostile_name_is_refused_as_text(console: Console, name: str) -> None:
    answer = post(console.visitor(), "/keys/create", name=name)
    page = Page(answer.text)
    assert answer.status_code == 400 and page.is_inert and "key name" in page.text
    queue = post(console.visitor(), "/keys/create", name="fine", queue=name)
    assert (queue.status_code == 400 and Page(queue.text).is_inert) or not name


def test_the_first_key_is_made_after_a_warning_and_from_then_on_everybody_needs_one(tmp_path: Path) -> None:
    with Serving(tmp_path, "--cpus", "1") as server, contextlib.closing(Visitor(server.url)) as visitor:
        assert "There is no key" in visitor.page("/keys").text
        asked = post(visitor, "/keys/create", name="first")
        assert asked.status_code == 409 and "everybody needs a key, you too" in Page(asked.text).text
        made = post(visitor, "/keys/create", name="first", confirmed="yes")
        (key,) = KeyStore(tmp_path).load().values()
        assert key.secret in made.text
        assert visitor.http.get("/keys", follow_redirects=False).headers["location"].startswith("/login")


def test_a_server_that_other_machines_can_reach_shows_keys_and_makes_none(tmp_path: Path) -> None:
    keys = KeyStore(tmp_path)
    secret = secret_of(keys.create("admin"))
    with (
        Serving(tmp_path, "--cpus", "1", "--host", "0.0.0.0") as server,
        contextlib.closing(Visitor(server.url, secret)) as visitor,
    ):
        page = visitor.page("/keys")
        assert "muster keys create NAME" in page.text and not page.all("form", action="/keys/create")
        for path, fields in (("/keys/create", {"name": "x"}), ("/keys/delete", {"name": "admin", "confirmed": "yes"})):
            answer = visitor.submit(path, **fields)
            assert answer.status_code == 403 and "other machines can reach this server" in answer.json()["message"]
        bearer = {"Authorization": f"Bearer {secret}"}
        answer = httpx.post(f"{server.url}/api/keys", json={"name": "x"}, headers=bearer, trust_env=False)
        assert answer.status_code == 403 and [key.name for key in keys.load().values()] == ["admin"]
