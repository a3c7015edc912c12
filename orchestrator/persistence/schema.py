"""The schema of the database: created at once in a new database, else migrated."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Column, Connection, MetaData, String, Table, insert, inspect, select

from orchestrator.persistence.batch_models import Base, ComputeEnvironment, JobQueue
from orchestrator.persistence.own_models import KnownAccount  # noqa: F401 (its tables, too)

MIGRATIONS = Path(__file__).parent / "migrations"
NEWEST = max(path.name for path in (MIGRATIONS / "versions").glob("[0-9]*.py")).partition("_")[0]
"""Revision of the tables of :mod:`orchestrator.persistence.batch_models`."""
BASE = "0021"
"""Oldest revision that can be migrated."""
_VERSION = Table("alembic_version", MetaData(), Column("version_num", String(32), primary_key=True))


class UnknownSchema(Exception):
    """The database has a revision without a migration here: a newer one, or one from before the base.

    Attributes:
        revision: The revision; None: the database is from before revisions existed.
        is_older: Whether it is from before the base.
    """

    def __init__(self, revision: str | None) -> None:
        super().__init__(revision)
        self.revision = revision
        self.is_older = revision is None or revision < BASE


def schema_of(connection: Connection) -> str | None:
    """The revision of the database; None before it has one."""
    return connection.scalar(select(_VERSION.c.version_num)) if inspect(connection).has_table(_VERSION.name) else None


def bring_up_to_date(connection: Connection) -> None:
    """Create the tables, or migrate existing ones. Raises UnknownSchema.

    Alembic is imported only where there is something to migrate: it takes as long as half of the rest of a start.
    """
    present = schema_of(connection)
    if present == NEWEST:
        return
    if present is None and not inspect(connection).has_table("jobs"):
        if connection.dialect.name == "sqlite":  # Python's driver begins no transaction for CREATE TABLE
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        Base.metadata.create_all(connection)
        _VERSION.create(connection, checkfirst=True)
        connection.execute(insert(_VERSION).values(version_num=NEWEST))
        connection.execute(insert(ComputeEnvironment).values(name="local", document={"type": "UNMANAGED"}))
        connection.execute(insert(JobQueue).values(name="default", compute_environments=["local"]))
        return
    from alembic import command
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.attributes["connection"] = connection
    if present not in {each.revision for each in ScriptDirectory.from_config(config).walk_revisions()}:
        raise UnknownSchema(present)
    command.upgrade(config, "head")
