"""The fault that ended an attempt: type, file and line of an exception."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    op.add_column("attempts", sa.Column("fault", sa.String(), nullable=True))
