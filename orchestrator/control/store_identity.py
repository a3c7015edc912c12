"""The identity of a database's store: another or an empty volume under the store's path is not taken for it."""

from __future__ import annotations

import os
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.domain.errors import Unavailable
from orchestrator.persistence.batch_models import Attempt, Job
from orchestrator.persistence.own_models import KnownStore
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Store, StoreError
from shared_store.volume.plugin_folders import note_plugins

_NEWEST = 100
"""How many of the newest runs of a database are looked for in a store without an identity."""
_MOUNTED = "see whether its volume is mounted"
_REMEDY = f"{_MOUNTED}; --adopt-store takes what is there as the store of this controller"


class StoreAbsent(Unavailable):
    """The volume of the store is not there, or another one is."""


@dataclass(frozen=True)
class StoreIdentity:
    """The store as the database knows it."""

    store: Store
    identity: str

    def check(self) -> None:
        """Raises OSError where the volume is not there, or holds another store."""
        if (problem := self.problem()) is not None:
            raise OSError(problem)

    def problem(self) -> str | None:
        """Why what is under the store's path is not the store, or can't be read; None where it is. May hang."""
        try:
            found = self.store.identity()
        except FileNotFoundError:
            return f"there is no store at {self.store.path}; see whether its volume is mounted"
        except (OSError, ValueError) as error:
            return f"the store at {self.store.path} can't be read ({error})"
        if found != self.identity:
            return f"another store is at {self.store.path}; see whether the right volume is mounted there"
        return None


def recognise(session: Session, store: Store, adopt: bool) -> StoreIdentity:
    """Open the store that the database belongs to, and remember it at the first start.

    A database that knows no store yet, of an older Muster, takes the one that has its runs.

    Args:
        session: The session.
        store: The store under the path that was given.
        adopt: Whether to take it, whatever it is.

    Raises:
        StoreError: It is not the database's, or can't be used.
    """
    known = session.get(KnownStore, 1)
    try:
        present = store.identity()
    except FileNotFoundError:
        present = None
    except (OSError, ValueError) as error:
        raise StoreError(f"store {store.path}: store.json can't be read ({error})") from error
    if not adopt:
        if known is not None and known.identity != present:
            if present is None:
                raise StoreError(
                    f"store {store.path}: there is no store there; {_MOUNTED}; --adopt-store begins a new one"
                )
            raise StoreError(f"store {store.path}: another store is there, not the one of this controller; {_REMEDY}")
        if known is None and not _has_runs(session, store):
            raise StoreError(f"store {store.path}: none of the runs of this controller's jobs is there; {_REMEDY}")
    identity = store.open().identity()
    assert identity is not None
    try:
        note_plugins(store)
    except (OSError, DamagedFile) as error:
        raise StoreError(f"store {store.path}: plugins.json can't be written ({error})") from error
    session.merge(KnownStore(id=1, identity=identity))
    return StoreIdentity(store, identity)


def _has_runs(session: Session, store: Store) -> bool:
    """Whether the store has one of the newest runs that the database knows; True where it knows none."""
    query = select(Job.run).join(Attempt).order_by(Job.created_at.desc()).limit(_NEWEST)
    runs = dict.fromkeys(session.scalars(query))
    return not runs or any(os.path.lexists(store.run(run).path / "run.json") for run in runs)
