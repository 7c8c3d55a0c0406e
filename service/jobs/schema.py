"""The tables' version: workers bring a database up to date, everything else waits until one has."""

from __future__ import annotations

import time
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory

from service.errors import FailedError
from service.jobs.database import is_sqlite, reading, writing

FOLDER = Path(__file__).parent / "migrations"
LOCK = 0x63617573  # of PostgreSQL, while the tables change
POLL_S = 0.05


def upgrade_schema(database: sa.Engine) -> None:
    """Bring the tables up to date, one process at a time. FailedError where they are newer than this program."""
    with writing(database) as connection:
        if not is_sqlite(connection):
            connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": LOCK})
        _require_known(connection)
        config = _config()
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def await_schema(database: sa.Engine, timeout_s: float) -> None:
    """Return once a worker has brought the tables up to date; FailedError after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    head = ScriptDirectory.from_config(_config()).get_current_head()
    while True:
        found, trouble = _version(database)
        if found == head:
            return
        if time.monotonic() > deadline:
            raise FailedError(f"the database is not ready: {trouble or f'its tables have version {found}, not {head}'}")
        time.sleep(POLL_S)


def _version(database: sa.Engine) -> tuple[str | None, str]:
    try:
        with reading(database) as connection:
            return MigrationContext.configure(connection).get_current_revision(), ""
    except sa.exc.OperationalError as error:
        return None, str(error.orig)


def _require_known(connection: sa.Connection) -> None:
    found = MigrationContext.configure(connection).get_current_revision()
    known = {script.revision for script in ScriptDirectory.from_config(_config()).walk_revisions()}
    if found is not None and found not in known:
        raise FailedError(f"the database was made by a newer causticmill (its tables have version {found})")


def _config() -> Config:
    config = Config()
    config.set_main_option("script_location", str(FOLDER).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config
