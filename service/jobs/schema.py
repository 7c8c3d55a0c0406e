"""The tables' version: workers bring a database up to date, everything else waits until one has.

alembic is imported only where there is something to do: it is slow to import and large, and mostly there is not.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import sqlalchemy as sa

from service.errors import FailedError
from service.jobs.database import is_sqlite, reading, writing

if TYPE_CHECKING:
    from alembic.config import Config

HEAD = "0003"  # the last of the migrations; a test compares
FOLDER = Path(__file__).parent / "migrations"
LOCK = 0x63617573  # of PostgreSQL, while the tables change
POLL_S = 0.05
_TABLE = sa.table("alembic_version", sa.column("version_num"))


def upgrade_schema(database: sa.Engine) -> None:
    """Bring the tables up to date, one process at a time. FailedError where they are newer than this program."""
    with reading(database) as connection:
        if _version_in(connection) == HEAD:
            return
    from alembic import command

    config = alembic_config()
    with writing(database) as connection:
        if not is_sqlite(connection):
            connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": LOCK})
        _require_known(connection, config)
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def await_schema(database: sa.Engine, timeout_s: float) -> None:
    """Return once a worker has brought the tables up to date; FailedError after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while True:
        found, trouble = _version(database)
        if found == HEAD:
            return
        if time.monotonic() > deadline:
            raise FailedError(f"the database is not ready: {trouble or f'its tables have version {found}, not {HEAD}'}")
        time.sleep(POLL_S)


def alembic_config() -> Config:
    """What alembic needs to know of us."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(FOLDER).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


def _version(database: sa.Engine) -> tuple[str | None, str]:
    try:
        with reading(database) as connection:
            return _version_in(connection), ""
    except sa.exc.OperationalError as error:
        return None, str(error.orig)


def _version_in(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table(_TABLE.name):
        return None
    return connection.execute(sa.select(_TABLE.c.version_num)).scalar()


def _require_known(connection: sa.Connection, config: Config) -> None:
    from alembic.script import ScriptDirectory

    found = _version_in(connection)
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    if found is not None and found not in known:
        raise FailedError(f"the database was made by a newer causticmill (its tables have version {found})")
