"""An attempt's column ``pool`` is called what it holds, its compute environment."""

from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    op.execute("ALTER TABLE attempts RENAME COLUMN pool TO compute_environment")
