"""Sessions of the console: what opens one, and what ends it."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.api.http import access
from orchestrator.api.http.access import Access
from orchestrator.persistence.access_keys import KeyStore
from orchestrator.services.permissions import Actor, Refusal
from tests.support.keys import key_store

SECRET = bytes(32)


@pytest.fixture
def keys(tmp_path: Path) -> KeyStore:
    return key_store(tmp_path)


def supplied(keys: KeyStore, name: str) -> str:
    key = next(each for each in keys.current().values() if each.name == name)
    return f"{key.access_key_id}:{key.secret}"


def test_a_session_has_the_rights_of_its_key_as_they_are_now(keys: KeyStore) -> None:
    keys.create("a", ("robots",), read_only=True)
    here = Access(keys, console_secret=SECRET)
    session = here.sign_in(supplied(keys, "a"))
    assert here.session(session) == Actor("key a", frozenset({"robots"}), True, "a")
    keys.delete("a")
    keys.create("a")
    assert here.session(session) is None, "another key of the same name"


def test_work_for_another_has_the_rights_that_they_have_now(keys: KeyStore) -> None:
    """Automatic evaluations ask so: whoever would not be admitted has no rights."""
    names = ("MUSTER_TOKEN", "user ann", "address 10.0.0.1", "this process", "key a")
    here, with_token = Access(keys), Access(keys, "a-token-of-the-server")
    assert [here.actor_named(name) for name in names] == [*map(Actor, names[:4]), None], "no key was ever demanded"
    keys.create("a", ("robots",), read_only=True)
    key = Actor("key a", frozenset({"robots"}), True, "a")
    assert [here.actor_named(name) for name in names] == [None, None, None, Actor("this process"), key]
    assert with_token.actor_named("MUSTER_TOKEN") == Actor("MUSTER_TOKEN")
    keys.delete("a")
    assert [here.actor_named(name) for name in names] == [None, None, None, Actor("this process"), None]


def test_a_changed_session_is_none(keys: KeyStore) -> None:
    keys.create("a")
    keys.create("b")
    here = Access(keys, console_secret=SECRET)
    session = here.sign_in(supplied(keys, "a"))
    name, end, rest = session.split(".", 2)
    other = supplied(keys, "b").partition(":")[0]
    changed = [f"{other}.{end}.{rest}", f"{name}.{int(end) + 1}.{rest}", session[:-1], session + "0"]
    changed += ["", ".", "...", "ä.1.x.y"]
    assert [here.session(each) for each in changed] == [None] * len(changed)
    assert Access(keys).session(session) is None, "of another server"


def test_the_servers_token_opens_a_session_that_ends_when_the_token_changes() -> None:
    session = Access(None, "a-token-of-the-server", console_secret=SECRET).sign_in("a-token-of-the-server")
    assert "a-token" not in session
    assert Access(None, "a-token-of-the-server", console_secret=SECRET).session(session) == Actor("MUSTER_TOKEN")
    assert Access(None, "another-token-of-it", console_secret=SECRET).session(session) is None
    assert Access(None, None, console_secret=SECRET).session(session) is None
    with pytest.raises(Refusal, match="token is unknown"):
        Access(None, "a-token-of-the-server").sign_in("")


def test_a_session_ends_after_half_a_day_and_at_the_logout(keys: KeyStore, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1_700_000_000.0
    monkeypatch.setattr(access.time, "time", lambda: now)
    keys.create("a")
    here = Access(keys, console_secret=SECRET)
    session, other = here.sign_in(supplied(keys, "a")), here.sign_in(supplied(keys, "a"))
    here.sign_out(session)
    assert here.session(session) is None and here.session(other) is not None
    now += access.SESSION - 1
    assert here.session(other) is not None
    now += 2
    assert here.session(other) is None


def test_forms_of_two_sessions_and_of_two_servers_have_different_tokens() -> None:
    here, existing = Access(console_secret=SECRET), Access()
    assert len({here.form_token(""), here.form_token("a"), existing.form_token(""), existing.form_token("a")}) == 4
