"""Whose runs and jobs are: runs with an owner and a queue, those of the first job of each run."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"

_FIRST_JOBS = """
INSERT INTO runs (name, owner, queue, created_at)
SELECT run, owner, queue, created_at FROM (
  SELECT run, owner, queue, created_at, row_number() OVER (PARTITION BY run ORDER BY created_at, id) AS place
  FROM jobs WHERE first_epoch IS NOT NULL
) AS numbered WHERE place = 1
"""
"""Jobs that never started have created no run."""


def upgrade() -> None:
    op.add_column("jobs", sa.Column("owner", sa.String()))
    # an idempotency key begins with the name of the key that sent it; other jobs do not say who submitted them
    split = "split_part(idempotency_key, '/', 1)"
    if op.get_bind().dialect.name == "sqlite":
        split = "substr(idempotency_key, 1, instr(idempotency_key, '/') - 1)"
    op.execute(f"UPDATE jobs SET owner = {split} WHERE idempotency_key IS NOT NULL")
    op.create_table(
        "runs",
        sa.Column("name", sa.String(), primary_key=True),
        sa.Column("owner", sa.String()),
        sa.Column("queue", sa.String(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
    )
    op.execute(_FIRST_JOBS)
