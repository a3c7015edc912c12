"""Access keys and the controller's own secrets, which were files of its home directory."""

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"


def upgrade() -> None:
    op.create_table(
        "sealed_secrets",
        sa.Column("name", sa.String(), primary_key=True),
        sa.Column("sealed", sa.String(), nullable=False),
    )
    op.create_table(
        "access_keys",
        sa.Column("name", sa.String(), primary_key=True),
        sa.Column("access_key_id", sa.String(), nullable=False, unique=True),
        sa.Column("sealed", sa.String(), nullable=False),
        sa.Column("queues", sa.JSON()),
        sa.Column("read_only", sa.Boolean(), nullable=False),
        sa.Column("share", sa.String(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
    )
