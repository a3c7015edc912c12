"""Upkeep: what nothing needs any more goes: deleted queues that are empty, long texts, old jobs and runs."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.kept_texts import KeptTexts
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.retention import Retention
from orchestrator.control.store_access import StoreAccess
from orchestrator.control.writes import Writes
from orchestrator.domain.job import TERMINAL
from orchestrator.persistence.batch_models import Job, JobQueue
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import Database

INTERVAL = 2.0
"""Seconds between two runs."""


class Upkeep:
    """On the controller's thread alone, but for :meth:`drain`."""

    def __init__(
        self,
        database: Database,
        writes: Writes,
        access: StoreAccess,
        texts: KeptTexts,
        retention: Retention,
        monitoring: Monitoring,
    ) -> None:
        self._database, self._writes, self._access = database, writes, access
        self._texts, self._retention, self._monitoring = texts, retention, monitoring
        self._ran = 0.0
        self._is_draining = True
        """Whether a deleted queue may still be there."""

    def drain(self, session: Session, queue: JobQueue) -> None:
        """Ask all jobs of a queue to end; it goes with the last of them."""
        self._is_draining = True
        ask_to_end(session, Job.queue == queue.name, f"job queue {queue.name} was deleted")

    def run(self) -> None:
        """Clear away what is due."""
        if machine.monotonic() - self._ran < INTERVAL or not self._writes.lock.acquire(blocking=False):
            return  # a request writes: gangs must not wait for that
        try:
            self._ran = machine.monotonic()
            self._delete_queues()
            self._texts.sweep_when_due(self._access.calls.later)
            self._retention.when_due(self._access.calls.later)
        finally:
            self._writes.lock.release()

    def _delete_queues(self) -> None:
        """Delete the queues that are to go and have no open job."""
        if not self._is_draining:
            return
        deleted = list[str]()
        with self._database.session() as session:
            queues = session.scalars(select(JobQueue).where(JobQueue.deleting)).all()
            for queue in queues:
                busy = select(Job.id).where(Job.queue == queue.name, Job.status.not_in(TERMINAL)).limit(1)
                if session.scalars(busy).first() is None:
                    session.delete(queue)
                    deleted.append(queue.name)
        self._is_draining = len(deleted) < len(queues)
        for name in deleted:
            self._monitoring.forget_queue(name)
