"""Lift a database of an older Muster to the oldest schema that this one reads.

    python -m docs.tools.lift_database ~/.muster/muster.db
    python -m docs.tools.lift_database postgresql+psycopg://user@host/muster

Stop the controller and back the database up before: a lift can't be undone. What the controller does at its next start is left to it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.util import CommandError
from sqlalchemy import Connection, inspect

from orchestrator.persistence.schema import schema_of
from orchestrator.persistence.session import Database, DatabaseError

SCHEMAS = Path(__file__).parent / "older_schemas"
"""Migrations from the first version's tables to those of the base revision."""


class LiftedDatabase(Database):
    """A database that is lifted when it is opened, under the controller's own lock.

    Raises:
        DatabaseError: It can't be opened, a controller has it, or it has no tables of an older Muster.
    """

    def _migrate(self) -> None:
        with self._unchecked() as connection:
            lift(connection)


def lift(connection: Connection, revision: str = "head") -> None:
    """Bring the tables to a revision, by default the base. Raises DatabaseError where they are not an older Muster's."""
    config = Config()
    config.set_main_option("script_location", str(SCHEMAS))
    config.attributes["connection"] = connection
    if schema_of(connection) is None and inspect(connection).has_table("jobs"):
        command.stamp(config, "0001")  # the first version had no revisions
    try:
        command.upgrade(config, revision)
    except CommandError as error:
        raise DatabaseError(f"not a database of an older Muster: {error}") from None


def main() -> int:
    """Lift the database that the command line names; the exit status is 2 where it can't be."""
    parser = argparse.ArgumentParser(prog="python -m docs.tools.lift_database", description=__doc__.splitlines()[0])
    parser.add_argument("database", help="the file of an SQLite database, or the URL of another one")
    name = parser.parse_args().database
    if "://" not in name and not Path(name).is_file():
        print(f"{name}: there is no such file", file=sys.stderr)
        return 2
    try:
        database = LiftedDatabase(name if "://" in name else f"sqlite:///{Path(name).resolve()}")
    except DatabaseError as error:
        print(error, file=sys.stderr)
        return 2
    with database.engine.connect() as connection:
        print(f"{database.shown}: schema {schema_of(connection)}; start the controller again")
    database.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
