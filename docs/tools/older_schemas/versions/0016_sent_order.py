"""A job queue's ``computeEnvironmentOrder`` as it was sent."""

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"


def upgrade() -> None:
    op.add_column("job_queues", sa.Column("sent_order", sa.JSON(), nullable=True))
