"""Databases of older versions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, create_engine

from docs.tools.lift_database import LiftedDatabase, lift


def make_older(url: str, revision: str) -> None:
    """Bring the database to that revision of an older version's tables."""
    with connected(url) as connection:
        lift(connection, revision)


def lift_whole(url: str) -> None:
    """Bring an older version's database to the tables of today, as the command does."""
    LiftedDatabase(url).close()


@contextmanager
def connected(url: str) -> Iterator[Connection]:
    """A transaction of nobody's."""
    engine = create_engine(url)
    with engine.begin() as connection:
        yield connection
    engine.dispose()
