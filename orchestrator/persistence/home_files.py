"""Files in which the home directory of an older Muster had keys and secrets: what they hold moves into the database."""

from __future__ import annotations

import logging
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from orchestrator.persistence.access_keys import Key, KeysError, KeyStore
from orchestrator.persistence.own_models import SealedSecret
from orchestrator.persistence.own_secrets import BUS_KEY, BUS_PORT, CONSOLE, OwnSecrets
from shared_store.volume.files import read_json, sync_directory

_MOVED = ".migrated"
"""Added to the name of a file whose content is in the database."""
_SESSION_KEY = 32
"""Bytes."""

log = logging.getLogger("muster.keys")


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid")
    keys: tuple[Key, ...]


def move_in(home: Path, own: OwnSecrets, keys: KeyStore) -> None:
    """Add what the files hold to the database, in one transaction, and rename them. Does nothing beside a controller.

    What the database has already stays. So a process that is killed at any moment loses nothing: a file is renamed after its content is
    committed, and adding that again changes nothing.

    Raises:
        KeysError: A file can't be used, or has another key by the name of one of the database's.
        SealError, DatabaseError: The secrets can't be kept.
    """
    if own.database.is_beside:  # its controller does
        return
    files = [path for name in ("keys.json", "bus.json", "console.secret") if (path := home / name).exists()]
    if not files:
        return
    added = _keys(home / "keys.json", keys)
    secrets = {**_bus(home / "bus.json"), **_console(home / "console.secret")}
    with own.database.session() as session:
        for key in added:
            keys.add(session, key)
        for name, text in secrets.items():
            if session.get(SealedSecret, name) is None:
                own.put(session, name, text)
    keys.load()
    try:
        for path in files:
            path.chmod(0o600)
            path.rename(path.with_name(path.name + _MOVED))
        (home / "keys.lock").unlink(missing_ok=True)
        sync_directory(home)
    except OSError as error:
        raise KeysError(
            f"{home}: files whose secrets are in the database now can't be renamed ({error.strerror}); make the directory writable"
        ) from None
    log.warning(
        "%s: moved into the database, sealed with sealing.key; back that file up, and delete the %s files once all is well",
        ", ".join(map(str, files)),
        f"*{_MOVED}",
    )


def _keys(path: Path, keys: KeyStore) -> list[Key]:
    """The keys of the file that the database has not. Raises KeysError."""
    if not path.exists():
        return []
    advice = "restore the file, or delete it and create its keys again with `muster keys create`"
    try:
        if (mode := path.stat().st_mode & 0o777) & 0o077:
            raise KeysError(
                f"{path}: has mode {mode:04o}, so others can read the secrets or change them; run chmod 600 on it, and "
                "replace the keys if someone may have read them"
            )
        read = _Keys.model_validate_json(path.read_bytes()).keys
    except OSError as error:
        raise KeysError(f"{path}: can't be read: {error.strerror}; make it readable for this user") from None
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise KeysError(f"{path}: {where + ': ' if where else ''}{first['msg']}; {advice}") from None
    present = dict(keys.load())
    added: list[Key] = []
    for key in read:
        if key.access_key_id in present:
            continue
        if any(key.name == each.name for each in present.values()):
            raise KeysError(
                f"{path}: there is another key {key.name} already; give this one another name in the file, or take it out"
            )
        present[key.access_key_id] = key
        added.append(key)
    return added


def _bus(path: Path) -> dict[str, str]:
    """Key and port of the bus. Raises KeysError."""
    advice = "restore it, or delete it: then nodes that run now take no commands"
    try:
        kept = read_json(path)
    except (OSError, ValueError) as error:
        raise KeysError(f"{path}: can't be read ({error}); {advice}") from None
    if kept is None:
        return {}
    key, port = kept.get("key"), kept.get("port")
    if not isinstance(key, str) or not isinstance(port, int):
        raise KeysError(f"{path}: has no key or no port; {advice}")
    return {BUS_KEY: key, BUS_PORT: str(port)}


def _console(path: Path) -> dict[str, str]:
    """The key of the console's sessions. Raises KeysError."""
    try:
        kept = path.read_bytes()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise KeysError(f"{path}: can't be read: {error.strerror}; make it readable for this user") from None
    if len(kept) != _SESSION_KEY:
        raise KeysError(
            f"{path}: has {len(kept)} bytes and not {_SESSION_KEY}; restore it, or delete it: then people log in to the console again"
        )
    return {CONSOLE: kept.hex()}
