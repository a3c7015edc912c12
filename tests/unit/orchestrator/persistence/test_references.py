"""Which jobs may go, by the rules of their queues, of the controller and of the Batch API."""

from __future__ import annotations

import pytest
from sqlalchemy import select, text

from orchestrator.domain.retention import A_DAY, BATCH_DAYS, RetentionRules
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.retention_rows import due, jobs_of_runs
from orchestrator.persistence.session import Database
from tests.support.orchestrator.rows import job

NOW = 1_000 * A_DAY
QUEUES = {"short": A_DAY // 2, "kept": None}


@pytest.mark.parametrize(
    ("rules", "queue", "from_yaml", "age"),
    [
        (RetentionRules(QUEUES, ["any"], default=A_DAY), "short", True, A_DAY // 2),
        (RetentionRules(QUEUES, ["any"], default=A_DAY), "kept", False, None),
        (RetentionRules(QUEUES, ["any"], default=A_DAY), "any", True, A_DAY),
        (RetentionRules(QUEUES, ["any"], default=A_DAY), "any", False, A_DAY),
        (RetentionRules(QUEUES, ["any"], default=A_DAY), "deleted", False, None),
        (RetentionRules(others=["any"]), "any", True, None),
        (RetentionRules(others=["any"]), "any", False, BATCH_DAYS * A_DAY),
        (RetentionRules(others=["any"]), "deleted", False, None),
        (RetentionRules(others=["any"], batch=False), "any", False, None),
        (RetentionRules(others=["any"], since=NOW - 5 * A_DAY), "any", False, None),
        (RetentionRules(QUEUES, since=NOW - 5 * A_DAY), "short", False, A_DAY // 2),
    ],
)
def test_a_rule_of_a_queue_goes_before_that_of_the_controller_which_goes_before_the_batch_api_s(
    database: Database, rules: RetentionRules, queue: str, from_yaml: bool, age: int | None
) -> None:
    """``age``: from which a job is due; None: it never is."""
    ends = {"at once": 1, "open": None, "young": NOW - (age or 0) + 1, "old": NOW - (age or 0)}
    with database.session() as session:
        for name, end in ends.items():
            status = "RUNNING" if end is None else "SUCCEEDED"
            session.add(job(name, run="r", queue=queue, from_yaml=from_yaml, status=status, stopped_at=end))
    with database.session() as session:
        found = sorted(session.scalars(select(Job.id).where(due(rules, NOW))))
        facts = jobs_of_runs(session, ["r"], rules, NOW)["r"]
    assert found == ([] if age is None else ["at once", "old"])
    assert sorted(each.id for each in facts if each.is_due) == found and len(facts) == len(ends)


def test_the_oldest_due_jobs_are_found_by_time_and_not_by_sorting_all_jobs_of_their_queues(database: Database) -> None:
    query = select(Job.id).where(due(RetentionRules(others=["any", "other"]), NOW)).order_by(Job.stopped_at).limit(100)
    written = query.compile(database.engine, compile_kwargs={"literal_binds": True})
    with database.session() as session:
        plan = " ".join(row.detail for row in session.execute(text(f"EXPLAIN QUERY PLAN {written}")))
    assert "ix_jobs_ended" in plan and "TEMP B-TREE" not in plan, plan
