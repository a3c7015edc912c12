"""Access keys and secrets of a home directory, whether a controller runs there or not: as another process sees them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from orchestrator.cli.keys import opened
from orchestrator.persistence.access_keys import Key, KeyStore
from orchestrator.persistence.own_secrets import OwnSecrets
from orchestrator.persistence.session import Database


class HomeKeys:
    """The keys of a home directory, as ``muster keys`` uses them."""

    def __init__(self, home: Path) -> None:
        self.home = home

    def create(
        self, name: str, queues: Sequence[str] | None = None, read_only: bool = False, share: str | None = None
    ) -> Key:
        with opened(self.home) as keys:
            return keys.create(name, queues, read_only, share)

    def delete(self, name: str) -> None:
        with opened(self.home) as keys:
            keys.delete(name)

    def load(self) -> Mapping[str, Key]:
        with opened(self.home) as keys:
            return keys.load()


def secret_of_home(home: Path, name: str) -> str | None:
    """One of the controller's own secrets."""
    database = Database.at(home, beside=True)
    try:
        return OwnSecrets(database, home).get(name)
    finally:
        database.close()


def put_secret(home: Path, name: str, text: str) -> None:
    """Replace one of them, while no controller runs."""
    database = Database.at(home)
    try:
        OwnSecrets(database, home)[name] = text
    finally:
        database.close()


def key_store(home: Path) -> KeyStore:
    """The keys of a new database, in a test without a server."""
    return KeyStore(OwnSecrets(Database.at(home), home))
