"""Indexes for pages of the list of jobs, in place of those for parts of it."""

from alembic import op

revision = "0017"
down_revision = "0016"

_NEW = {
    "ix_jobs_list": ["parent", "created_at", "id"],
    "ix_jobs_list_kind": ["parent", "queue", "status", "created_at", "id"],
}
_OLD = {"ix_jobs_parent": ["parent"]}


def upgrade() -> None:
    for name, columns in _NEW.items():
        op.create_index(name, "jobs", columns)
    for name in _OLD:
        op.drop_index(name, "jobs")


def downgrade() -> None:
    for name, columns in _OLD.items():
        op.create_index(name, "jobs", columns)
    for name in _NEW:
        op.drop_index(name, "jobs")
