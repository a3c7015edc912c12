"""The controller's own secrets in the database, sealed: the bus's key, the key of the console's sessions, the webhooks.

The database holds secrets encrypted, and the file that opens them lies in the home directory: a copy of the database alone, such as a
backup or a PostgreSQL server, reveals none of these, nor an access key. The environments of jobs are there as submitted, in clear.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy.orm import Session

from orchestrator.domain.errors import ServerError
from orchestrator.persistence.own_models import SealedSecret
from orchestrator.persistence.session import Database
from shared_store.volume.files import write_atomic

if TYPE_CHECKING:
    from cryptography.fernet import Fernet

_LOST = "docs/keys.md (The sealing key) says what to do where it is lost"
_PROOF = "proof"
"""Name of the row by which a controller sees that its sealing key is the database's."""
BUS_KEY, BUS_PORT, CONSOLE, WEBHOOKS = "bus-key", "bus-port", "console", "webhooks"


class SealError(ServerError):
    """A secret can't be sealed or opened; the message, one line without any secret, names the file and what to do."""


class Seal:
    """The sealing key of a home directory."""

    def __init__(self, home: Path) -> None:
        self.path = home / "sealing.key"

    def make(self) -> None:
        """Make the key where there is none, for its user alone. The caller holds the home directory's lock. Raises SealError."""
        from cryptography.fernet import Fernet

        if self.path.exists():
            return
        try:
            write_atomic(self.path, Fernet.generate_key() + b"\n", mode=0o600)
        except OSError as error:
            raise SealError(
                f"{self.path}: can't be written ({error.strerror}); check the disk and MUSTER_HOME"
            ) from None

    def close(self, text: str) -> str:
        """The text, sealed. Raises SealError."""
        return self._fernet.encrypt(text.encode()).decode()

    def open(self, sealed: str, what: str) -> str:
        """The text that was sealed; ``what`` it is stands in the error. Raises SealError."""
        from cryptography.fernet import InvalidToken

        try:
            return self._fernet.decrypt(sealed.encode()).decode()
        except InvalidToken:
            raise SealError(
                f"{self.path}: does not open {what} in the database: put back the file with which that was sealed, from a backup "
                f"or from the home directory of another controller of this database; {_LOST}"
            ) from None

    @cached_property
    def _fernet(self) -> Fernet:
        from cryptography.fernet import Fernet  # takes a while to import

        try:
            if (mode := self.path.stat().st_mode & 0o777) & 0o077:
                raise SealError(
                    f"{self.path}: has mode {mode:04o}, so others can open the secrets of the database; run chmod 600 on it, and "
                    "replace the keys if someone may have read it"
                )
            return Fernet(self.path.read_bytes().strip())
        except FileNotFoundError:
            raise SealError(
                f"{self.path}: missing, and it alone opens the secrets in the database: put it back from a backup, or copy it from "
                f"the home directory of another controller of this database; {_LOST}"
            ) from None
        except OSError as error:
            raise SealError(f"{self.path}: can't be read ({error.strerror}); make it readable for this user") from None
        except ValueError:
            raise SealError(f"{self.path}: is not a sealing key; put it back from a backup; {_LOST}") from None


class OwnSecrets:
    """Secrets by name. Any thread may call."""

    def __init__(self, database: Database, home: Path) -> None:
        """Open the seal of a database, and make its sealing key at its first use: so the caller holds the home directory's lock.

        Raises:
            SealError: The home directory has not the sealing key of this database.
            DatabaseError: The database can't be used.
        """
        self.database, self.seal = database, Seal(home)
        with database.session() as session:
            proof = session.get(SealedSecret, _PROOF)
            if proof is not None:
                self.seal.open(proof.sealed, "the secrets")
                return
            if database.is_beside:
                raise SealError(f"database {database.shown}: its controller is only starting; try again in a moment")
            self.seal.make()
            session.add(SealedSecret(name=_PROOF, sealed=self.seal.close("muster")))

    def get(self, name: str, /) -> str | None:
        """The secret of this name; None where there is none. Raises SealError, DatabaseError."""
        with self.database.session() as session:
            return self._of(session, name)

    def __setitem__(self, name: str, text: str, /) -> None:
        """Replace a secret. Raises SealError, DatabaseError."""
        with self.database.session() as session:
            self.put(session, name, text)

    def made(self, name: str, make: Callable[[], str]) -> str:
        """The secret of this name, made where there is none. Raises SealError, DatabaseError."""
        with self.database.session() as session:
            found = self._of(session, name)
            if found is None:
                self.put(session, name, found := make())
            return found

    def put(self, session: Session, name: str, text: str) -> None:
        """Replace a secret; nothing is committed. Raises SealError."""
        session.merge(SealedSecret(name=name, sealed=self.seal.close(text)))

    def _of(self, session: Session, name: str) -> str | None:
        row = session.get(SealedSecret, name)
        return None if row is None else self.seal.open(row.sealed, f"secret {name}")
