"""A job queue's column ``environments`` is called ``compute_environments``, like the values that it holds."""

from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    op.execute("ALTER TABLE job_queues RENAME COLUMN environments TO compute_environments")
