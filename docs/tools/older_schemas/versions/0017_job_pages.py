"""Indexes that have each part of the list of jobs in its order, in place of two that also hold the children of arrays."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"

_NEW = {
    "ix_jobs_list": ["created_at", "id", "queue", "name", "run", "owner"],
    "ix_jobs_list_queue": ["queue", "created_at", "id"],
    "ix_jobs_list_status": ["status", "created_at", "id"],
    "ix_jobs_list_kind": ["queue", "status", "created_at", "id"],
}
_OLD = {
    "ix_jobs_parent": ["parent"],
    "ix_jobs_status": ["status"],
    "ix_jobs_queue_created": ["queue", "created_at", "id"],
}


def upgrade() -> None:
    for name in _OLD:
        op.drop_index(name, "jobs")
    for name, columns in _NEW.items():
        _create(name, [*columns, "parent"], "parent IS NULL")
    _create("ix_jobs_parent", ["parent"], "parent IS NOT NULL")


def _create(name: str, columns: list[str], within: str) -> None:
    where = sa.text(within)
    op.create_index(name, "jobs", columns, sqlite_where=where, postgresql_where=where)
