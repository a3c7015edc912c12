"""The base revision: databases are created from the models, so it changes nothing. Later migrations follow it."""

revision = "0021"
down_revision = None


def upgrade() -> None:
    """Nothing: a database of this revision has its tables already."""


def downgrade() -> None:
    """Nothing: there is no older revision."""
