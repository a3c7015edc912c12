"""Sealing: what a copy of the database reveals, and the message where the sealing key is not the database's."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.persistence.own_secrets import OwnSecrets, Seal, SealError
from orchestrator.persistence.session import Database

TEXT = "a-secret-of-the-bus"


def used(home: Path) -> Path:
    """The sealing key of a database with a secret."""
    database = Database.at(home)
    own = OwnSecrets(database, home)
    own["bus-key"] = TEXT
    database.close()
    return own.seal.path


def refused(home: Path) -> str:
    database = Database.at(home)
    try:
        with pytest.raises(SealError) as caught:
            OwnSecrets(database, home).get("bus-key")
    finally:
        database.close()
    assert "\n" not in str(caught.value) and TEXT not in str(caught.value)
    return str(caught.value)


def test_the_database_has_no_secret_in_clear_and_the_key_is_its_users_alone(tmp_path: Path) -> None:
    key = used(tmp_path)
    assert not [file for file in tmp_path.iterdir() if TEXT.encode() in file.read_bytes()]
    assert key.stat().st_mode & 0o777 == 0o600
    database = Database.at(tmp_path)
    assert OwnSecrets(database, tmp_path).get("bus-key") == TEXT
    assert OwnSecrets(database, tmp_path).made("console", lambda: "made") == "made"
    assert OwnSecrets(database, tmp_path).made("console", lambda: "again") == "made"
    database.close()


def test_without_the_sealing_key_nothing_is_made_in_its_place(tmp_path: Path) -> None:
    key = used(tmp_path)
    text = key.read_bytes()
    key.unlink()
    assert f"{key}: missing" in refused(tmp_path) and "docs/keys.md" in refused(tmp_path) and not key.exists()
    Seal(tmp_path).make()
    assert f"{key}: does not open the secrets in the database: put back the file" in refused(tmp_path)
    key.write_bytes(b"no key")
    assert f"{key}: is not a sealing key" in refused(tmp_path)
    key.write_bytes(text)
    key.chmod(0o644)
    assert f"{key}: has mode 0644" in refused(tmp_path)
    key.chmod(0o600)
    Seal(tmp_path).make()
    assert key.read_bytes() == text


def test_a_secret_that_was_changed_in_the_database_is_named(tmp_path: Path) -> None:
    key = used(tmp_path)
    database = Database.at(tmp_path)
    with database.session() as session:
        session.connection().exec_driver_sql("UPDATE sealed_secrets SET sealed = 'x' WHERE name = 'bus-key'")
    database.close()
    assert f"{key}: does not open secret bus-key in the database" in refused(tmp_path)
