"""Access keys in the database: what other processes see of them, and what stays in force while it can't be read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.api.http.access import Access
from orchestrator.persistence import access_keys
from orchestrator.persistence.access_keys import Key, KeyStore, KeyUsageError
from orchestrator.persistence.own_secrets import OwnSecrets
from orchestrator.persistence.session import Database, DatabaseError, DatabaseTaken
from tests.support.waiting import wait_for


@pytest.fixture
def keys(database: Database, tmp_path: Path) -> KeyStore:
    return KeyStore(OwnSecrets(database, tmp_path))


@pytest.fixture
def others(keys: KeyStore, tmp_path: Path) -> Iterator[KeyStore]:
    """The same keys, as another process has them."""
    database = Database.at(tmp_path, beside=True)
    yield KeyStore(OwnSecrets(database, tmp_path))
    database.close()


def names(keys: KeyStore) -> list[str]:
    return [key.name for key in keys.current().values()]


def test_a_key_of_another_process_is_seen_at_the_next_look_and_its_deletion_too(
    keys: KeyStore, others: KeyStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = others.create("a", ["robots", "robots"], read_only=True)
    assert names(keys) == []
    keys.refresh()
    assert keys.current() == {made.access_key_id: made} and made.queues == ("robots",) and made.secret not in repr(made)
    monkeypatch.setattr(access_keys, "INTERVAL", 0.01)
    keys.start()
    others.delete("a")
    others.create("b")
    wait_for(lambda: names(keys) == ["b"], what="the look")
    keys.delete("b")
    assert names(keys) == [], "this process sees its own changes at once"
    keys.close()


def test_a_name_is_used_once_and_every_name_is_checked(keys: KeyStore, others: KeyStore) -> None:
    keys.create("a")
    for wrong in (
        lambda: others.create("a"),
        lambda: keys.create("../x"),
        lambda: keys.create("b", ["x y"]),
        lambda: keys.create("b", share="a-b"),
        lambda: keys.create("b", share="x" * 256),
        lambda: keys.delete("b"),
    ):
        with pytest.raises(KeyUsageError):
            wrong()
    assert names(keys) == ["a"]


@pytest.mark.parametrize(
    ("name", "requested", "share"), [("ann", None, "ann"), ("ann-2.b_c", None, "ann2bc"), ("ann", "lab", "lab")]
)
def test_a_key_has_the_letters_and_digits_of_its_name_as_its_share(
    keys: KeyStore, name: str, requested: str | None, share: str
) -> None:
    assert keys.create(name, share=requested).share == share
    with pytest.raises(KeyUsageError, match=f"would have the share of key {name}: --share {share} shares it") as caught:
        keys.create(share + "_")
    assert "\n" not in str(caught.value)
    assert keys.create(share + "_", share=share).share == share
    older = {"name": name, "accessKeyId": "MSTR234567ABCDEFGHIJ", "secret": "s" * 40, "createdAt": 1}
    assert requested or Key.model_validate(older).share == share


def test_a_look_that_fails_as_none_should_is_not_the_last_one(
    keys: KeyStore, others: KeyStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    keys.create("a")
    monkeypatch.setattr(access_keys, "INTERVAL", 0.01)
    keys.start()
    with monkeypatch.context() as patch:
        patch.setattr(keys, "_opened", lambda row: 1 / 0)
        others.create("b")
        wait_for(lambda: caplog.records, what="a look that fails")
        assert names(keys) == ["a"]
    others.delete("a")
    wait_for(lambda: names(keys) == ["b"], what="the next look")
    assert len(caplog.records) == 1 and "those that were read last stay in force" in caplog.text
    keys.close()


def test_while_the_database_can_t_be_read_the_keys_stay_and_a_damaged_one_is_refused_alone(
    keys: KeyStore, database: Database, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    keys.create("a")
    keys.create("b")

    def fail() -> None:
        raise DatabaseError("database d: gone")

    with monkeypatch.context() as patch:
        patch.setattr(database, "check", fail)
        for _ in range(3):
            keys.refresh()
            assert names(keys) == ["a", "b"]
        with pytest.raises(DatabaseError):
            keys.load()
    assert caplog.text == ""
    with database.session() as session:
        session.connection().exec_driver_sql("UPDATE access_keys SET sealed = 'x' WHERE name = 'b'")
    for _ in range(3):
        keys.refresh()
        assert names(keys) == ["a"]
    assert [record.message for record in caplog.records] == [
        "key b is damaged in the database, and is refused: muster keys delete b, and create it again"
    ]
    keys.delete("a")
    assert names(keys) == [] and not keys.is_empty and Access(keys).demanded(), "damage opens nothing"
    keys.delete("b")
    assert keys.is_empty and not Access(keys).demanded()


def test_a_database_is_opened_beside_its_controller_in_the_same_shape_alone(database: Database, tmp_path: Path) -> None:
    with pytest.raises(DatabaseTaken):
        Database.at(tmp_path)
    with pytest.raises(DatabaseError, match="is not there yet"):
        Database.at(tmp_path / "elsewhere", beside=True)
    assert not (tmp_path / "elsewhere").exists()
    with database.session() as session:
        session.connection().exec_driver_sql("UPDATE alembic_version SET version_num = '0019'")
    with pytest.raises(DatabaseError, match="has schema 0019, and this Muster needs"):
        Database.at(tmp_path, beside=True)
