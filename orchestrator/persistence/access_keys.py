"""Access keys for callers of the server: rows of the database, with their secrets sealed.

The database holds the secrets themselves, because a signature can be checked only with the secret that made it.
"""

from __future__ import annotations

import logging
import re
import secrets
import string
import threading
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel
from sqlalchemy import Row, delete, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.domain.errors import ServerError, Unavailable, UsageError
from orchestrator.domain.identifiers import ACCESS_KEY_ID, SHARE
from orchestrator.persistence.own_models import AccessKey
from orchestrator.persistence.own_secrets import OwnSecrets, SealError
from shared_store.volume.layout import NAME

INTERVAL = 1.0
"""Seconds after which a process sees at the latest which keys another one has made or deleted."""
PATIENCE = 2.0
"""Seconds for which a caller with an unknown key waits for the database."""
_NAME_PATTERN = f"^(?:{NAME.pattern})$"
_ID_LETTERS = string.ascii_uppercase + "234567"
_SECRET_LETTERS = string.ascii_letters + string.digits
"""No punctuation: a secret can be pasted into a shell, an INI file and a bearer header as it is (40 letters: 238 bits)."""
_TABLE = AccessKey.__table__

log = logging.getLogger("muster.keys")


class KeysError(ServerError):
    """Keys can't be used, made or deleted; the message says why and what to do."""


class KeyUsageError(KeysError, UsageError):
    """The name of a key, of its queue or of its share can't be used."""


class Key(BaseModel):
    """A pair that signs requests, and its permissions."""

    model_config = ConfigDict(frozen=True, extra="forbid", alias_generator=to_camel, validate_by_name=True)
    name: str = Field(pattern=_NAME_PATTERN)
    access_key_id: str = Field(pattern=f"^{ACCESS_KEY_ID}$")
    secret: str = Field(pattern=r"^[!-~]{16,256}$", repr=False)
    queues: tuple[str, ...] | None = None
    """Names of the queues that it may use; None: all."""
    read_only: bool = False
    share: str = Field(default_factory=lambda key: share_of_name(key.get("name", "")), pattern=f"^{SHARE}$")
    """Share identifier of its jobs in queues with a fair-share policy."""
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


def share_of_name(name: str) -> str:
    """The share of a key of this name that names no other: its letters and digits."""
    return re.sub(r"[^A-Za-z0-9]", "", name)


class KeyStore:
    """The keys of a database: what the database had at the last poll is in memory, and a poll takes place every second.

    So no request waits for the database, and whatever another process makes or deletes is seen within that second.
    """

    def __init__(self, own: OwnSecrets) -> None:
        """Raises DatabaseError."""
        self._database, self._seal = own.database, own.seal
        self._polling = threading.Lock()
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._is_failing = False
        """Whether the last poll failed as none should: one line of the log says so."""
        self._polled = 0.0
        """When the last poll began (monotonic [s])."""
        self._rows: Sequence[Row[Any]] = ()
        self._keys: Mapping[str, Key] = {}
        self._poll()

    def current(self) -> Mapping[str, Key]:
        """The keys by access key id, as they were at the last poll; cheap enough for every request."""
        return self._keys

    @property
    def is_empty(self) -> bool:
        """Whether the database had no key, not even a damaged one, at the last poll."""
        return not self._rows

    def load(self) -> Mapping[str, Key]:
        """The keys by access key id, as the database has them now. Raises DatabaseError."""
        with self._polling:
            self._poll()
        return self._keys

    def refresh(self) -> None:
        """Poll for a key that another process may just have made; callers who wait for the same poll share it.

        Where the database does not answer in time, what was read last stays in force.
        """
        requested_at = machine.monotonic()
        if self._polling.acquire(timeout=PATIENCE):
            try:
                if self._polled <= requested_at:
                    self._poll_safely()
            finally:
                self._polling.release()

    def start(self) -> None:
        """Poll every second from now on."""
        self._thread = machine.thread("keys", self._loop)

    def close(self) -> None:
        """Poll no more."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(PATIENCE)

    def create(
        self, name: str, queues: Sequence[str] | None = None, read_only: bool = False, share: str | None = None
    ) -> Key:
        """Add a key with a new pair.

        Args:
            name: Of its user or program.
            queues: Names of the queues that it may use; all where there is none.
            read_only: Whether it may change nothing.
            share: Share identifier of its jobs; the letters and digits of the name where None.

        Raises:
            KeyUsageError: A name can't be used, or there is a key of that name.
            SealError, DatabaseError: It can't be kept.
        """
        if not NAME.fullmatch(name):
            raise KeyUsageError(
                f"key name {name!r}: 1 to 128 letters, digits, '.', '_' and '-', a letter or digit first"
            )
        for queue in queues or ():
            if not NAME.fullmatch(queue):
                raise KeyUsageError(f"--queue {queue!r}: give the name of a queue, such as default")
        if share is not None and not re.fullmatch(SHARE, share):
            raise KeyUsageError(f"--share {share[:100]!r}: 1 to 255 letters and digits")
        others = {each.share: each.name for each in self.load().values() if each.name != name}
        if share is None and (other := others.get(share_of_name(name))):
            raise KeyUsageError(
                f"key {name} would have the share of key {other}: --share {share_of_name(name)} shares it, another name does not"
            )
        key = Key(
            name=name,
            access_key_id="MSTR" + "".join(secrets.choice(_ID_LETTERS) for _ in range(16)),
            secret="".join(secrets.choice(_SECRET_LETTERS) for _ in range(40)),
            queues=tuple(dict.fromkeys(queues)) if queues else None,
            read_only=read_only,
            share=share or share_of_name(name),
            created_at=int(machine.wall() * 1000),
        )
        try:
            with self._database.session() as session:
                self.add(session, key)
        except IntegrityError:
            raise KeyUsageError(
                f"there is a key {name} already; choose another name, or first: muster keys delete {name}"
            ) from None
        self.load()
        return key

    def add(self, session: Session, key: Key) -> None:
        """Add a key; nothing is committed. Raises IntegrityError where there is one of its name or its id."""
        row = key.model_dump(exclude={"secret"})
        session.execute(insert(AccessKey).values(**row, sealed=self._seal.close(key.secret)))

    def delete(self, name: str) -> None:
        """Delete a key: this process refuses it from its next request on, others within a second. Raises KeyUsageError, DatabaseError."""
        with self._database.session() as session:
            deleted = session.execute(delete(AccessKey).where(AccessKey.name == name).returning(AccessKey.name)).all()
        present = ", ".join(each.name for each in self.load().values()) or "none"
        if not deleted:
            raise KeyUsageError(f"key {name!r} does not exist; available: {present}")

    def _loop(self) -> None:
        while not self._ending.wait(INTERVAL):
            with self._polling:
                self._poll_safely()

    def _poll_safely(self) -> None:
        try:
            self._poll()
            self._is_failing = False
        except Unavailable:
            pass  # reported by the controller; the keys that were read last stay in force
        except Exception:  # whatever it was, the next poll sees keys that are deleted meanwhile
            if not self._is_failing:
                log.exception("the keys can't be read; those that were read last stay in force")
            self._is_failing = True

    def _poll(self) -> None:
        """Read the rows, and open them where they have changed."""
        self._polled = machine.monotonic()
        with self._database.session() as session:
            rows = session.execute(select(_TABLE).order_by(_TABLE.c.created_at, _TABLE.c.name)).all()
        if rows != self._rows:
            self._keys = {key.access_key_id: key for row in rows if (key := self._opened(row))}
            self._rows = rows

    def _opened(self, row: Row[Any]) -> Key | None:
        """The key of a row; None of a damaged one, which is refused: the others stay in force."""
        facts = {name: value for name, value in row._mapping.items() if name != "sealed"}
        try:
            return Key(**facts, secret=self._seal.open(row.sealed, f"the secret of key {row.name}"))
        except (ValidationError, SealError):
            name = row.name[:128]
            log.error(
                "key %s is damaged in the database, and is refused: muster keys delete %s, and create it again",
                name,
                name,
            )
            return None
