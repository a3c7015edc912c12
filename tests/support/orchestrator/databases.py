"""Databases of older versions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, create_engine

from orchestrator.persistence.schema import MIGRATIONS


def migrate(url: str, direction: str, revision: str) -> None:
    """``upgrade`` or ``downgrade`` the database to that revision of its tables."""
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    with connected(url) as connection:
        config.attributes["connection"] = connection
        getattr(command, direction)(config, revision)


@contextmanager
def connected(url: str) -> Iterator[Connection]:
    """A transaction of nobody's."""
    engine = create_engine(url)
    with engine.begin() as connection:
        yield connection
    engine.dispose()
