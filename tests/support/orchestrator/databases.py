"""Databases of older versions."""

from __future__ import annotations

from alembic import command
from alembic.config import Config
from sqlalchemy import create_engine

from orchestrator.persistence.schema import MIGRATIONS


def migrate(url: str, direction: str, revision: str) -> None:
    """``upgrade`` or ``downgrade`` the database to that revision of its tables."""
    config, engine = Config(), create_engine(url)
    config.set_main_option("script_location", str(MIGRATIONS))
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        getattr(command, direction)(config, revision)
    engine.dispose()
