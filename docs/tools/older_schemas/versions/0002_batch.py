"""Queues, compute environments, policies, arrays, dependencies, shares, and what attempts have used."""

import time
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def _job_columns() -> tuple[sa.Column[Any], ...]:
    """New ones at each call: a column belongs to one table."""
    return (
        sa.Column("kind", sa.String(), nullable=False, server_default="multinode"),
        sa.Column("runnable_at", sa.BigInteger()),
        sa.Column("evaluate_on_exit", sa.JSON(), nullable=False, server_default="[]"),
        sa.Column("cancelled", sa.Boolean(), nullable=False, server_default=sa.false()),
        sa.Column("share", sa.String()),
        sa.Column("priority", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("parameters", sa.JSON(), nullable=False, server_default="{}"),
        sa.Column("tags", sa.JSON(), nullable=False, server_default="{}"),
        sa.Column("parent", sa.String()),
        sa.Column("array_index", sa.BigInteger()),
        sa.Column("array_size", sa.BigInteger()),
        sa.Column("idempotency_key", sa.String()),
    )


def _attempt_columns() -> tuple[sa.Column[Any], ...]:
    amounts = ("gpu_seconds", "cpu_seconds", "wasted_gpu_seconds", "wasted_cpu_seconds")
    return (
        sa.Column("pool", sa.String()),
        *(sa.Column(name, sa.Double(), nullable=False, server_default="0") for name in amounts),
    )


def _named(*columns: sa.Column[Any]) -> tuple[sa.Column[Any], ...]:
    """The columns shared by queues, compute environments and policies, around ``columns``."""
    return (
        sa.Column("name", sa.String(), primary_key=True),
        *columns,
        sa.Column("tags", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
    )


def upgrade() -> None:
    queues = op.create_table(
        "job_queues",
        *_named(
            sa.Column("state", sa.String(), nullable=False),
            sa.Column("priority", sa.BigInteger(), nullable=False),
            sa.Column("environments", sa.JSON(), nullable=False),
            sa.Column("policy", sa.String()),
            sa.Column("limits", sa.JSON(), nullable=False),
            sa.Column("deleting", sa.Boolean(), nullable=False),
        ),
    )
    environments = op.create_table(
        "compute_environments",
        *_named(sa.Column("state", sa.String(), nullable=False), sa.Column("document", sa.JSON(), nullable=False)),
    )
    op.create_table("scheduling_policies", *_named(sa.Column("fairshare", sa.JSON(), nullable=False)))
    op.create_table(
        "dependencies",
        sa.Column("job_id", sa.String(), sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("on_id", sa.String(), primary_key=True, index=True),
        sa.Column("kind", sa.String()),
    )
    op.create_table(
        "share_usage",
        sa.Column("queue", sa.String(), primary_key=True),
        sa.Column("share", sa.String(), primary_key=True),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("as_of", sa.BigInteger(), nullable=False),
    )
    op.add_column("job_definitions", sa.Column("tags", sa.JSON(), nullable=False, server_default="{}"))
    with op.batch_alter_table("jobs") as jobs:
        for column in _job_columns():
            jobs.add_column(column)
        jobs.create_unique_constraint("uq_jobs_idempotency_key", ["idempotency_key"])
        jobs.create_index("ix_jobs_parent", ["parent"])
        jobs.create_index("ix_jobs_stopped_at", ["stopped_at"])
        jobs.create_index("ix_jobs_queue_status", ["queue", "status", "created_at", "id"])
        jobs.create_index("ix_jobs_queue_created", ["queue", "created_at", "id"])
        jobs.drop_index("ix_jobs_queue")
    with op.batch_alter_table("attempts") as attempts:
        for column in _attempt_columns():
            attempts.add_column(column)
    created = {"tags": {}, "created_at": int(time.time() * 1000), "state": "ENABLED"}
    op.bulk_insert(environments, [{**created, "name": "local", "document": {"type": "UNMANAGED"}}])
    queue = {"priority": 1, "environments": ["local"], "policy": None, "limits": [], "deleting": False}
    op.bulk_insert(queues, [{**created, **queue, "name": "default"}])
