"""The tables of a new database: all of them, or none."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import event, select

from orchestrator.persistence.models import Base, JobQueue
from orchestrator.persistence.session import Database


def test_a_first_start_that_is_interrupted_leaves_nothing_half_made(tmp_path: Path) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    jobs = Base.metadata.tables["jobs"]
    event.listen(jobs, "after_create", interrupted)
    try:
        with pytest.raises(KeyboardInterrupt):
            Database.at(tmp_path)
    finally:
        event.remove(jobs, "after_create", interrupted)
    database = Database.at(tmp_path)
    with database.session() as session:
        assert [queue.name for queue in session.scalars(select(JobQueue))] == ["default"]
    database.close()
