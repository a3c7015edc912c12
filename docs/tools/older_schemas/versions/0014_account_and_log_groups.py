"""The account in the ARNs, and log groups of users."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"


def upgrade() -> None:
    account = op.create_table(
        "account",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("account", sa.String(), nullable=False),
        sa.Column("region", sa.String(), nullable=False),
        sa.PrimaryKeyConstraint("id"),
    )
    # the ARNs that clients of this database know
    op.bulk_insert(account, [{"id": 1, "account": "000000000000", "region": "us-east-1"}])
    op.create_table(
        "log_groups",
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("owner", sa.String(), nullable=True),
        sa.Column("retention", sa.BigInteger(), nullable=True),
        sa.Column("tags", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("name"),
    )
    op.create_table(
        "log_streams",
        sa.Column("log_group", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("created_at", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["log_group"], ["log_groups.name"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("log_group", "name"),
    )
    op.add_column("nodes", sa.Column("log_group", sa.String(), nullable=True))
    op.add_column("nodes", sa.Column("log_prefix", sa.String(), nullable=True))
    op.create_index("ix_nodes_log_group", "nodes", ["log_group"])
