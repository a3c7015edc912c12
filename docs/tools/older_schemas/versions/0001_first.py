"""Definitions, jobs and attempts, as the first version made them."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "job_definitions",
        sa.Column("name", sa.String(), primary_key=True),
        sa.Column("revision", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.Column("status", sa.String(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
    )
    op.create_table(
        "jobs",
        sa.Column("id", sa.String(), primary_key=True),
        sa.Column("name", sa.String(), nullable=False, index=True),
        sa.Column("queue", sa.String(), nullable=False, index=True),
        sa.Column("definition", sa.String(), nullable=False),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("node_properties", sa.JSON(), nullable=False),
        sa.Column("run", sa.String(), nullable=False, index=True),
        sa.Column("status", sa.String(), nullable=False, index=True),
        sa.Column("status_reason", sa.String()),
        sa.Column("created_at", sa.BigInteger(), nullable=False, index=True),
        sa.Column("started_at", sa.BigInteger()),
        sa.Column("stopped_at", sa.BigInteger()),
        sa.Column("attempts_allowed", sa.BigInteger(), nullable=False),
        sa.Column("timeout", sa.BigInteger()),
        sa.Column("stop_reason", sa.String()),
        sa.Column("first_epoch", sa.BigInteger()),
    )
    op.create_table(
        "attempts",
        sa.Column("job_id", sa.String(), sa.ForeignKey("jobs.id"), primary_key=True),
        sa.Column("number", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("epoch", sa.BigInteger(), nullable=False),
        sa.Column("handle", sa.String()),
        sa.Column("ending", sa.String()),
        sa.Column("spent", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
        sa.Column("started_at", sa.BigInteger()),
        sa.Column("stopped_at", sa.BigInteger()),
        sa.Column("status_reason", sa.String()),
        sa.Column("exit_code", sa.BigInteger()),
        sa.Column("nodes", sa.JSON(), nullable=False),
    )
