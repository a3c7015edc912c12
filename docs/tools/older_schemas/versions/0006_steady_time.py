"""Steady time: when jobs came and attempts began, on a clock that no step of the wall clock moves."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    op.create_table(
        "clock",
        sa.Column("id", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("boot", sa.String(), nullable=False),
        sa.Column("offset", sa.BigInteger(), nullable=False),
        sa.Column("drift", sa.BigInteger(), nullable=False),
    )
    op.add_column("jobs", sa.Column("queued_since", sa.BigInteger()))
    op.add_column("attempts", sa.Column("held_since", sa.BigInteger()))
    op.add_column("attempts", sa.Column("running_since", sa.BigInteger()))
    # at its beginning steady time is the wall clock's
    op.execute("UPDATE jobs SET queued_since = created_at WHERE status NOT IN ('SUCCEEDED', 'FAILED')")
    op.execute("UPDATE attempts SET held_since = created_at, running_since = started_at WHERE stopped_at IS NULL")
