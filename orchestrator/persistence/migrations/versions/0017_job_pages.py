"""Indexes that have each part of the list of jobs in its order, in place of two that also hold the children of arrays."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"

_NEW = {
    "ix_jobs_list": [],
    "ix_jobs_list_queue": ["queue"],
    "ix_jobs_list_status": ["status"],
    "ix_jobs_list_kind": ["queue", "status"],
}
_OLD = {"ix_jobs_status": ["status"], "ix_jobs_queue_created": ["queue", "created_at", "id"]}


def upgrade() -> None:
    within = sa.text("parent IS NULL")
    for name, columns in _NEW.items():
        op.create_index(name, "jobs", [*columns, "created_at", "id"], sqlite_where=within, postgresql_where=within)
    for name in _OLD:
        op.drop_index(name, "jobs")


def downgrade() -> None:
    for name, columns in _OLD.items():
        op.create_index(name, "jobs", columns)
    for name in _NEW:
        op.drop_index(name, "jobs")
