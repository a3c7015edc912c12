"""A database and a store with jobs that ended long ago."""

from __future__ import annotations

import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

from sqlalchemy import func, select, update

from orchestrator.control.disk import Disk
from orchestrator.control.peers import Peers
from orchestrator.control.retention import Retention
from orchestrator.control.retention_facts import CONTROLLER, Requester, Step
from orchestrator.control.store_access import StoreAccess
from orchestrator.domain.retention import A_DAY, BATCH_DAYS
from orchestrator.persistence.batch_models import Attempt, Base, Dependency, Job, Node, RunRecord, now
from orchestrator.persistence.keyset import Cursor
from orchestrator.persistence.own_models import RunUse
from orchestrator.persistence.session import Database
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from tests.support.orchestrator.rows import job

LONG_AGO = now() - (BATCH_DAYS + 1) * A_DAY


class World:
    """A database and a store, with jobs that ended long ago."""

    def __init__(self, home: Path) -> None:
        self.database = Database(f"sqlite:///{home}/muster.db")
        self.store = Store(home / "store").open()
        self.access: Any = StoreAccess(self.store, Peers(self.store, home), Disk({}))
        self.users, self.writing, self.beginning = self.access.users, threading.Lock(), self.access.beginning

    def retention(self, default: float | None = None) -> Retention:
        return Retention(self.database, self.access, self.writing, now, default)

    def step(
        self, after: Cursor = Cursor(), *, take: bool, by: Requester = CONTROLLER, most: int = 100, **rules: Any
    ) -> Step:
        """A step, with other rules."""
        retention = self.retention()
        return retention.step(after, replace(retention.rules(), **rules), take=take, by=by, most=most)

    def reasons(self) -> dict[str, str]:
        """Of each run that is kept, why."""
        steps, _ = self.step(take=False)
        return {each["run"]: "; ".join(each["kept"]) for each in steps if each["kept"]}

    def ended(self, name: str, *, run: str | None = None, directory: bool = True, **facts: Any) -> None:
        """A job with an attempt, a node, an owner and a run with a log."""
        run = run or name
        values = {"status": "SUCCEEDED", "stopped_at": LONG_AGO, "owner": "key a", "run": run, **facts}
        with self.database.session() as session:
            session.add(job(name, **values))
            session.add(Attempt(job_id=name, number=1, epoch=1, nodes=[Node(index=0, host="h")], stopped_at=1))
            session.merge(RunRecord(name=run, queue="default", owner=values["owner"]))
        if directory:
            place = self.store.run(run)
            write_json(place.path / "run.json", {"run": run, "spec": None}, levels=2)
            place.logs(name, 1).mkdir(parents=True)
            place.log(name, 1, 0).write_bytes(b"x" * 1000)
            write_json(place.outcome(name, 1, 0), {}, levels=3)

    def change(self, name: str, **values: Any) -> None:
        with self.database.session() as session:
            session.execute(update(Job).where(Job.id == name).values(values))

    def add(self, *rows: Base) -> None:
        with self.database.session() as session:
            session.add_all(rows)

    def jobs(self) -> list[str]:
        with self.database.session() as session:
            return sorted(session.scalars(select(Job.id)))

    def runs(self) -> list[str]:
        return sorted(run.name for run in self.store.runs())

    def rows(self) -> int:
        """Of all tables that a job adds to."""
        tables = (Job, Attempt, Node, Dependency, RunUse, RunRecord)
        with self.database.session() as session:
            return sum(session.scalar(select(func.count()).select_from(table)) or 0 for table in tables)

    def trashed(self) -> list[str]:
        folder = self.store.path / "trash"
        return os.listdir(folder) if folder.exists() else []
