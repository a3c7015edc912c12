"""Access keys for callers of the server. Kept in ``$MUSTER_HOME/keys.json``, written by ``muster keys``, read by the server.

The file holds the secrets themselves, because a signature can be checked only with the secret that made it. So it is for its
owner alone (mode 0600), and a file that others can read is refused.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import secrets
import string
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.alias_generators import to_camel

from orchestrator.domain.errors import ServerError, UsageError
from shared_store.volume.files import sync_directory
from shared_store.volume.layout import NAME

_NAME_PATTERN = f"^(?:{NAME.pattern})$"
_ID_LETTERS = string.ascii_uppercase + "234567"
_SECRET_LETTERS = string.ascii_letters + string.digits
"""No punctuation: a secret can be pasted into a shell, an INI file and a bearer header as it is (40 letters: 238 bits)."""

log = logging.getLogger("muster.keys")


class KeysError(ServerError):
    """keys.json can't be used, or a key can't be made or deleted; the message says why and what to do."""


class KeyUsageError(KeysError, UsageError):
    """The name of a key or of its queue can't be used."""


class _Document(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", alias_generator=to_camel, validate_by_name=True)


class Key(_Document):
    """A pair that signs requests, and its permissions."""

    name: str = Field(pattern=_NAME_PATTERN)
    access_key_id: str = Field(pattern=r"^[A-Z0-9]{16,128}$")
    secret: str = Field(pattern=r"^[!-~]{16,256}$", repr=False)
    queues: tuple[str, ...] | None = None
    """Names of the queues that it may use; None: all."""
    read_only: bool = False
    created_at: int
    """Milliseconds since 1970."""

    @property
    def rights(self) -> str:
        """Its permissions, in words."""
        queues = "all queues" if self.queues is None else f"queues {', '.join(self.queues)}"
        return f"{queues}, {'read only' if self.read_only else 'read and write'}"

    def describe(self) -> dict[str, Any]:
        """Everything but its secret, as JSON values."""
        return self.model_dump(mode="json", by_alias=True, exclude={"secret"})


class _File(_Document):
    keys: tuple[Key, ...]

    @model_validator(mode="after")
    def _distinct(self) -> _File:
        for what, values in (
            ("name", [key.name for key in self.keys]),
            ("accessKeyId", [key.access_key_id for key in self.keys]),
        ):
            if twice := next((value for value in values if values.count(value) > 1), None):
                raise ValueError(f"two keys have the {what} {twice}")
        return self


class KeyStore:
    """The keys of one home directory."""

    def __init__(self, home: Path) -> None:
        self.path = home / "keys.json"
        self._stamp: object = None
        self._keys: dict[str, Key] = {}
        self.unusable = False
        """Whether the file that :meth:`current` saw last could not be read."""

    def load(self) -> Mapping[str, Key]:
        """The keys by access key id; none where there is no file. Raises KeysError where it can't be trusted or read."""
        try:
            mode = self.path.stat().st_mode & 0o777
            if mode & 0o077:
                raise KeysError(
                    f"{self.path}: has mode {mode:04o}, so others can read the secrets or change them; run chmod 600 on it, and "
                    "replace the keys if someone may have read them"
                )
            document = _File.model_validate_json(self.path.read_bytes())
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise KeysError(f"{self.path}: can't be read: {error.strerror}; make it readable for this user") from None
        except ValidationError as error:
            first = error.errors(include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            raise KeysError(
                f"{self.path}: {where + ': ' if where else ''}{first['msg']}; restore the file, or delete it and create the keys "
                "again with `muster keys create`"
            ) from None
        return {key.access_key_id: key for key in document.keys}

    def current(self) -> Mapping[str, Key]:
        """The keys as the file has them now, read again only where it changed; cheap enough for every request.

        A file that has become unusable is logged once, and the keys that were read last stay.
        """
        stamp = self._look()
        if stamp != self._stamp:
            self._stamp = stamp
            try:
                self._keys = dict(self.load())
                self.unusable = False
            except KeysError as error:
                self.unusable = True
                log.error("%s (until then the %d keys that were read last stay in force)", error, len(self._keys))
        return self._keys

    def _look(self) -> object:
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return ()
        except OSError as error:
            return error.errno
        return status.st_mtime_ns, status.st_size, status.st_ino

    def create(self, name: str, queues: tuple[str, ...] | None = None, read_only: bool = False) -> Key:
        """Add a key with a new pair. Raises KeysError."""
        if not NAME.fullmatch(name):
            raise KeyUsageError(
                f"key name {name!r}: 1 to 128 letters, digits, '.', '_' and '-', a letter or digit first"
            )
        for queue in queues or ():
            if not NAME.fullmatch(queue):
                raise KeyUsageError(f"--queue {queue!r}: give the name of a queue, such as default")
        key = Key(
            name=name,
            access_key_id="MSTR" + "".join(secrets.choice(_ID_LETTERS) for _ in range(16)),
            secret="".join(secrets.choice(_SECRET_LETTERS) for _ in range(40)),
            queues=tuple(dict.fromkeys(queues)) if queues else None,
            read_only=read_only,
            created_at=int(time.time() * 1000),
        )

        def add(keys: list[Key]) -> list[Key]:
            if any(each.name == name for each in keys):
                raise KeyUsageError(
                    f"there is a key {name} already; choose another name, or first: muster keys delete {name}"
                )
            return [*keys, key]

        self._change(add)
        return key

    def delete(self, name: str) -> None:
        """Delete a key; a running server refuses it from its next request on. Raises KeysError."""

        def remove(keys: list[Key]) -> list[Key]:
            if all(each.name != name for each in keys):
                there = ", ".join(each.name for each in keys) or "no key"
                raise KeyUsageError(f"there is no key {name!r}; there is {there}")
            return [each for each in keys if each.name != name]

        self._change(remove)

    def _change(self, edit: Callable[[list[Key]], list[Key]]) -> None:
        try:
            with self._alone():
                keys = _File(keys=tuple(edit(list(self.load().values()))))
                self._write(keys.model_dump_json(by_alias=True, indent=1).encode() + b"\n")
        except OSError as error:
            raise KeysError(
                f"{self.path}: can't be written: {error.strerror}; check the disk and MUSTER_HOME"
            ) from None

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """One change at a time: two commands at once must not lose each other's key."""
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open(self.path.with_suffix(".lock"), "a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _write(self, data: bytes) -> None:
        """Replace the file, whole or not at all; at no instant is there a file that others may read."""
        descriptor, hidden = tempfile.mkstemp(
            prefix=".keys.", suffix=".tmp", dir=self.path.parent
        )  # mkstemp makes it 0600
        try:
            with open(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(hidden, self.path)
        except OSError:
            Path(hidden).unlink(missing_ok=True)
            raise
        sync_directory(self.path.parent)
