"""The version of the tables, and the opening of a database whose tables may be of an earlier one.

Workers bring a database up to date, everything else waits until one has. A database without tables gets those of
`tables.py`, and their version; the migrations are for those that have some. Each upgrade can be undone, because an
older program refuses newer tables. A SQLite file is first copied to causticmill.sqlite.before-0006 beside it, and the
copy stays. A PostgreSQL database is not copied by the program: the upgrade of tables that hold jobs waits until a
person states with CAUSTICMILL_UPGRADE_TO that a dump of them is kept. alembic is large and slow to import, so it is
imported only if there is something to do.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import sqlalchemy as sa

from service.errors import FailedError, InputError
from service.processes.files import keep_private
from service.server.database.connection import begin_reading, begin_writing, connect, copy_sqlite, is_sqlite
from service.server.database.tables import jobs, metadata
from service.settings import ServerSettings

if TYPE_CHECKING:
    from alembic.config import Config

HEAD = "0007"  # the last of the migrations; a test compares
FOLDER = Path(__file__).parent / "migrations"
LOCK = 0x63617573  # advisory lock of PostgreSQL, while the tables change
POLL_S = 0.05
_TABLE = sa.table("alembic_version", sa.column("version_num"))


def upgrade_schema(database: sa.Engine, *, allowed: str | None = None) -> None:
    """Bring the tables up to date, one process at a time. FailedError if they are newer than this program.

    allowed : the version to which PostgreSQL's tables may be brought although they hold jobs; InputError otherwise
    """
    with begin_reading(database) as connection:
        if _read_version(connection) == HEAD:
            return
    from alembic import command

    config = alembic_config()
    with begin_writing(database) as connection:
        if not is_sqlite(connection):
            connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": LOCK})
        config.attributes["connection"] = connection
        found = _read_version(connection)
        if found is None:
            metadata.create_all(connection)
            command.stamp(config, "head")
        elif found != HEAD:  # another process may have been first
            _require_known(found, config)
            _keep_way_back(connection, found, allowed)
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
    """Return the configuration for alembic."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(FOLDER).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


def _version(database: sa.Engine) -> tuple[str | None, str]:
    try:
        with begin_reading(database) as connection:
            return _read_version(connection), ""
    except sa.exc.OperationalError as error:
        return None, str(error.orig)


def _read_version(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table(_TABLE.name):
        return None
    return connection.execute(sa.select(_TABLE.c.version_num)).scalar()


def _keep_way_back(connection: sa.Connection, found: str, allowed: str | None) -> None:
    """Make the copy, or check that a person has made one. No one else upgrades meanwhile: the connection holds the
    lock.
    """
    if is_sqlite(connection):
        path = Path(str(connection.engine.url.database))
        copy, part = (path.with_name(f"{path.name}.before-{HEAD}{end}") for end in ("", ".part"))
        copy_sqlite(path, part)
        part.rename(copy)
    elif allowed != HEAD and connection.execute(sa.select(jobs.c.id).limit(1)).first() is not None:
        raise InputError(
            f"the database has tables of version {found}, and this program needs {HEAD}; no earlier program can use "
            f"them afterwards. Keep a copy first: pg_dump --format=custom --file=before-{HEAD}.dump DATABASE_URL; "
            f"then start with CAUSTICMILL_UPGRADE_TO={HEAD}"
        )


def _require_known(found: str, config: Config) -> None:
    from alembic.script import ScriptDirectory

    if found not in {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}:
        raise FailedError(
            f"the database was made by another causticmill: its tables have version {found}, this program needs {HEAD} "
            "and knows no way there"
        )


def open_database(settings: ServerSettings, *, migrate: bool = False) -> sa.Engine:
    """Open the database of these settings; `migrate` brings its tables up to date first (workers do, the API never)."""
    if settings.embedded:
        keep_private(settings.data)
    database = connect(settings.sqlalchemy_url)
    if migrate:
        upgrade_schema(database, allowed=settings.upgrade_to)
    return database
