"""Messages about jobs that ended, until their receivers have accepted them."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    op.create_table(
        "webhook_deliveries",
        sa.Column("id", sa.String(), primary_key=True),
        sa.Column("webhook", sa.String(), nullable=False),
        sa.Column("job", sa.String(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
        sa.Column("next_at", sa.BigInteger()),
        sa.Column("tries", sa.BigInteger(), nullable=False),
        sa.Column("body", sa.String()),
        sa.Column("problem", sa.String()),
    )
    op.create_index("ix_webhook_deliveries_due", "webhook_deliveries", ["webhook", "next_at"])
    op.create_index("ix_webhook_deliveries_job", "webhook_deliveries", ["job"])
