"""A table of the progress of trainings' automatic evaluations."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    op.create_table(
        "automatic_evaluations",
        sa.Column("run", sa.String(), primary_key=True),
        sa.Column("training", sa.String(), nullable=False),
        sa.Column("seen", sa.String(), nullable=False),
        sa.Column("waiting", sa.BigInteger(), nullable=False),
        sa.Column("passed", sa.BigInteger(), nullable=False),
        sa.Column("checkpoint", sa.String()),
        sa.Column("job", sa.String()),
        sa.Column("open", sa.Boolean(), nullable=False),
        sa.Column("problem", sa.String()),
    )
    op.create_index("ix_automatic_evaluations_open", "automatic_evaluations", ["open"])
