"""Whose key registered a job definition."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    op.add_column("job_definitions", sa.Column("owner", sa.String()))
