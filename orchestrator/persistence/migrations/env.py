"""Alembic's entry: runs the migrations on the connection that :class:`orchestrator.persistence.session.Database` hands over."""

from alembic import context

from orchestrator.persistence.batch_models import Base
from orchestrator.persistence.own_models import KnownAccount  # noqa: F401 (its tables, too)

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    render_as_batch=True,  # SQLite can't alter a column in place
)
with context.begin_transaction():
    context.run_migrations()
