"""Damaged rows of jobs in the database: requests about them fail, requests about others don't."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from orchestrator.domain.errors import ClientError
from orchestrator.domain.reasons import named
from orchestrator.persistence.batch_models import Job

DAMAGED = "the job's row in the database is damaged"


class DamagedRow(ClientError):
    """A job's row can't be read (409); the message names the job."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"job {named(job.name, job.id)}: {DAMAGED}; submit the job again", 409)


@contextmanager
def reading(job: Job) -> Iterator[None]:
    """A block that reads the JSON columns of a job: whatever fails in it because of them is a DamagedRow."""
    try:
        yield
    except Exception as error:
        if _is_intact(job):
            raise  # another cause
        raise DamagedRow(job) from error


def _is_intact(job: Job) -> bool:
    """Whether the JSON columns have the shapes in which they are written."""
    try:
        _ = job.gang.spec
        _ = [entry["action"] for entry in job.evaluate_on_exit or []]
        return all(isinstance(each, dict) for each in (job.request, job.parameters, job.tags))
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError):
        return False
