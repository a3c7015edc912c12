"""An index that has the newest job of a name and an owner first: a name stands for one's own job before another's."""

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"


def upgrade() -> None:
    where = sa.text("parent IS NULL")
    op.create_index(
        "ix_jobs_owned", "jobs", ["name", "owner", "created_at"], sqlite_where=where, postgresql_where=where
    )
