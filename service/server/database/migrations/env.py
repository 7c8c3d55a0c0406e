"""Alembic runs this: bring the database of the given connection up to date. `schema.py` calls it."""

from alembic import context

from service.server.database.tables import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    render_as_batch=True,
    transaction_per_migration=False,
)
# The caller's transaction, which holds the lock, is the one that commits.
context.run_migrations()
