"""The controller's own secrets in the database, sealed: the bus's key, the key of the console's sessions, the webhooks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sqlalchemy.orm import Session

from orchestrator.persistence.own_models import SealedSecret
from orchestrator.persistence.sealing import Seal, SealError
from orchestrator.persistence.session import Database

_PROOF = "proof"
"""Name of the row by which a controller sees that its sealing key is the database's."""
BUS_KEY, BUS_PORT, CONSOLE, WEBHOOKS = "bus-key", "bus-port", "console", "webhooks"


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
