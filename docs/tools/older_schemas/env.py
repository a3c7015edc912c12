"""Alembic's entry: runs the migrations on the connection of :func:`docs.tools.lift_database.lift`."""

from alembic import context

# SQLite can't alter a column in place
context.configure(connection=context.config.attributes["connection"], render_as_batch=True)
with context.begin_transaction():
    context.run_migrations()
