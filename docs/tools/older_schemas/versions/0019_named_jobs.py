"""An index that has the newest job of a name first, in place of one with the children of arrays: to look a job up reads one row."""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"


def upgrade() -> None:
    where = sa.text("parent IS NULL")
    op.create_index("ix_jobs_named", "jobs", ["name", "created_at"], sqlite_where=where, postgresql_where=where)
    op.drop_index("ix_jobs_name", "jobs")
