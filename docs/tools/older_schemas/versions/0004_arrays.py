"""The children of an array refer to the array's definition, parameters and tags instead of having copies."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

_SHARED = ("node_properties", "evaluate_on_exit", "parameters", "tags")


def upgrade() -> None:
    with op.batch_alter_table("jobs") as jobs:
        for name in _SHARED:
            jobs.alter_column(name, existing_type=sa.JSON(), nullable=True)
    cleared = ", ".join(f"{name} = NULL" for name in _SHARED)
    op.execute(f"UPDATE jobs SET {cleared} WHERE parent IN (SELECT id FROM jobs WHERE kind = 'array')")
