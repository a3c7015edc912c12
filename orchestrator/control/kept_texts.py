"""The long texts of jobs, in the store from their upload until nothing needs them (:mod:`shared_store.volume.texts`).

A text is kept while a job that has not ended names it, or an active job definition of a Batch client, and for some days after it was
uploaded or named last. A definition that a submission of Muster's made counts as little as any other part of its job that has ended.
The run of a job has a copy of its own from the first attempt on. Controllers that share a store have a folder each.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path

from sqlalchemy import String, cast, delete, func, select, update
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.domain.errors import RequestError, Unavailable
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.job import TERMINAL
from orchestrator.persistence.batch_models import Job, JobDefinition, now
from orchestrator.persistence.own_models import KeptText
from orchestrator.persistence.retention_rows import is_of_submission
from orchestrator.persistence.session import Database, DatabaseError
from shared_store.volume import texts
from shared_store.volume.layout import Store
from shared_store.volume.texts import LARGEST, Reference

log = logging.getLogger("muster.controller")

DAYS = 7
"""For which a text is kept that nothing names."""
A_DAY = 32 << 20
"""Bytes of texts that one key may upload in 24 hours."""
_SWEEP_INTERVAL, _FIRST_SWEEP = 3600.0, 60.0
"""Seconds between two searches for texts that nothing needs, and until the first one."""
_MS_A_DAY = 24 * 3600 * 1000


class TextRefused(RequestError):
    """A text is not kept; one line."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status


def references_of(gang: GangSpec) -> list[Reference]:
    """The texts that the specs of a job's nodes name; a spec that is none is refused where it is read."""
    found: dict[Reference, None] = {}
    for node in {id(node): node for node in gang.nodes}.values():
        with contextlib.suppress(ValueError, RecursionError):
            found |= dict.fromkeys(texts.references(node.spec))
    return list(found)


class KeptTexts:
    """The texts of one database. Any thread may use it; all methods but :meth:`source` may wait for the store."""

    def __init__(
        self,
        database: Database,
        store: Store,
        folder: str,
        writing: threading.Lock,
        shortage: Callable[[], str | None] = lambda: None,
    ) -> None:
        """
        Args:
            database: It knows the owner and the age of each text.
            store: The shared volume.
            folder: Name of the folder for new texts.
            writing: Held during each change of the database.
            shortage: Why nothing may be added to the store; None where it has room.
        """
        self._database, self._store, self._folder = database, store, folder
        self._writing, self._shortage = writing, shortage
        self._changing = threading.Lock()
        """Held while a text is written or deleted, together with its row."""
        self._next_sweep = machine.monotonic() + _FIRST_SWEEP

    def keep(self, data: bytes, owner: str) -> str:
        """Keep a text durably; returns its digest. A text that is kept already only stays longer.

        Args:
            data: UTF-8.
            owner: Its sender.

        Raises:
            TextRefused: It is too long or no text, or its owner has uploaded too much.
            Unavailable: The store has no room, or can't be written.
        """
        digest = _digest(data)
        if shortage := self._shortage():
            raise Unavailable(f"{shortage}; the text is not kept")
        with self._changing:
            with self._database.session() as session:
                self._check_share(session, digest, len(data), owner)
            try:
                texts.keep(self._store.texts / self._folder, data)
            except OSError as error:
                raise Unavailable(
                    f"the text can't be kept in {self._store.texts} ({error.strerror or error})"
                ) from None
            moment = now()
            row = KeptText(
                sha256=digest, owner=owner, folder=self._folder, size=len(data), uploaded_at=moment, used_at=moment
            )
            with self._writing, self._database.session() as session:
                session.merge(row)
        return digest

    def prolong(self, digest: str) -> None:
        """Keep a text as long as one that was named now."""
        with self._writing, self._database.session() as session:
            session.execute(update(KeptText).where(KeptText.sha256 == digest).values(used_at=now()))

    def source(self, session: Session, reference: Reference) -> Path:
        """The folder of a text, whether it is there or not."""
        row = session.get(KeptText, reference.sha256)
        return self._store.texts / (row.folder if row else self._folder)

    def sweep_when_due(self, later: Callable[[Callable[[], object]], None]) -> None:
        """Have ``later`` carry out :meth:`sweep` once in a while."""
        if machine.monotonic() > self._next_sweep:
            self._next_sweep = machine.monotonic() + _SWEEP_INTERVAL
            later(self.sweep)

    def sweep(self) -> list[str]:
        """Delete the texts that nothing needs, and leftovers of interrupted uploads; returns the names of the deleted files."""
        deleted = []
        try:
            with self._changing:
                with self._writing, self._database.session() as session:
                    old = session.scalars(select(KeptText).where(KeptText.used_at < now() - DAYS * _MS_A_DAY)).all()
                    named = _named(session) if old else set()
                    unneeded = [(row.folder, row.sha256) for row in old if row.sha256 not in named]
                    session.execute(delete(KeptText).where(KeptText.sha256.in_(name for _, name in unneeded)))
                for folder, name in unneeded:
                    (self._store.texts / folder / name).unlink(missing_ok=True)
                    deleted.append(name)
                with self._database.session() as session:
                    kept = set(session.scalars(select(KeptText.sha256).where(KeptText.folder == self._folder)))
                own = self._store.texts / self._folder
                with contextlib.suppress(FileNotFoundError):
                    for name in set(os.listdir(own)) - kept:
                        (own / name).unlink(missing_ok=True)
                        deleted.append(name)
        except (OSError, DatabaseError) as error:
            log.warning("texts that no job needs any more can't be deleted now (%s); trying again in an hour", error)
        return deleted

    def _check_share(self, session: Session, digest: str, size: int, owner: str) -> None:
        """Raises TextRefused where the owner has uploaded too much."""
        recent = select(func.sum(KeptText.size)).where(
            KeptText.owner == owner, KeptText.uploaded_at > now() - _MS_A_DAY, KeptText.sha256 != digest
        )
        if (session.scalar(recent) or 0) + size > A_DAY:
            raise TextRefused(
                f"{owner} has uploaded {A_DAY >> 20} MiB of texts in 24 hours, which is the most; submit again later",
                429,
            )


def _digest(data: bytes) -> str:
    """Raises TextRefused for what is too long or no text."""
    if len(data) > LARGEST:
        raise TextRefused(f"the text has {len(data):,} bytes, and may have {LARGEST:,}; shorten it", 413)
    try:
        return texts.digest_of(data.decode())
    except UnicodeDecodeError:
        raise TextRefused("it is not a text (UTF-8)") from None


def _named(session: Session) -> set[str]:
    """The digests in active definitions of Batch clients and in jobs that have not ended."""
    found: set[str] = set()
    for column, is_open in (
        (JobDefinition.document, JobDefinition.status == "ACTIVE"),
        (Job.own_node_properties, Job.status.not_in(TERMINAL)),
    ):
        text = cast(column, String)
        query = select(column, text.label("text")).where(is_open, text.contains("sha256"))
        for document, written in session.execute(query.execution_options(yield_per=100)):
            if column is Job.own_node_properties or not is_of_submission(document):
                found.update(re.findall(r"[0-9a-f]{64}", written))
    return found
