"""Retention: when it began, which jobs have a spec, and which runs they read."""

import json

import sqlalchemy as sa
from alembic import op

from orchestrator.persistence.batch_models import now

revision = "0018"
down_revision = "0017"

_JOBS = sa.table("jobs", *(sa.column(name) for name in ("id", "parent", "status", "node_properties", "from_yaml")))
_TERMINAL = ("SUCCEEDED", "FAILED")
_READING = ("evaluate", "race", "export", "record", "render")


def upgrade() -> None:
    retention = op.create_table(
        "retention",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("since", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id"),
    )
    op.bulk_insert(retention, [{"id": 1, "since": now()}])
    op.add_column("jobs", sa.Column("from_yaml", sa.Boolean(), nullable=False, server_default=sa.false()))
    text = sa.cast(_JOBS.c.node_properties, sa.String)
    op.execute(_JOBS.update().where(text.like("%MUSTER_SPEC%")).values(from_yaml=sa.true()))
    parents = sa.select(_JOBS.c.id).where(_JOBS.c.from_yaml == sa.true())
    op.execute(_JOBS.update().where(_JOBS.c.parent.in_(parents)).values(from_yaml=sa.true()))
    op.drop_index("ix_jobs_stopped_at", "jobs")
    op.create_index("ix_jobs_ended", "jobs", ["stopped_at", "from_yaml", "queue", "id"])
    op.create_index("ix_jobs_definition", "jobs", ["definition"])
    uses = op.create_table(
        "run_uses",
        sa.Column("job_id", sa.String(), nullable=False),
        sa.Column("run", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", "run"),
    )
    op.create_index("ix_run_uses_run", "run_uses", ["run"])
    is_open = sa.and_(_JOBS.c.status.not_in(_TERMINAL), text.like("%MUSTER_SPEC%"))
    rows = op.get_bind().execute(sa.select(_JOBS.c.id, text).where(is_open))
    found = [{"job_id": job, **use} for job, properties in rows for use in _uses(properties)]
    if found:
        op.bulk_insert(uses, found)


def _uses(properties: str) -> list[dict[str, object]]:
    """The runs that a job reads, or begins with the weights of. Damage names none."""
    found: set[str] = set()
    try:
        for each in json.loads(properties)["nodeRangeProperties"]:
            pairs = {pair["name"]: pair.get("value", "") for pair in each["container"].get("environment") or []}
            spec = json.loads(pairs.get("MUSTER_SPEC") or "{}")
            for kind in _READING:
                if isinstance(spec.get(kind), dict) and isinstance(spec[kind].get("run"), str):
                    found.add(spec[kind]["run"])
            teacher = ((spec.get("train") or {}).get("rsl_rl") or {}).get("teacher_checkpoint")
            for weights in (teacher, pairs.get("MUSTER_PARENT")):
                if weights:
                    found.add(str(weights).partition("@")[0])
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    return [{"run": run} for run in found]
