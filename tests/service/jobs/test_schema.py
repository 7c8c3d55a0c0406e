"""The migrations lead to exactly the tables that the program uses, on both databases, whoever comes first."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from service.errors import FailedError
from service.jobs.database import open_database, reading, writing
from service.jobs.schema import HEAD, alembic_config, await_schema, upgrade_schema
from service.jobs.tables import metadata
from service.settings import ServerSettings


def test_migrations_and_tables_agree(database: sa.Engine) -> None:
    """Nothing is left to do for alembic after an upgrade."""
    with reading(database) as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []


def test_the_version_that_is_waited_for_is_the_last_migration() -> None:
    assert ScriptDirectory.from_config(alembic_config()).get_heads() == [HEAD]


@pytest.mark.thorough
def test_a_database_that_is_up_to_date_costs_no_alembic(farm: ServerSettings, database: sa.Engine) -> None:
    """It is slow to import, and the API would carry it for ever."""
    code = """
import sys
from service.jobs.database import open_database
from service.jobs.schema import await_schema
from service.settings import ServerSettings
await_schema(open_database(ServerSettings.load(), migrate=True), 0)
sys.exit("alembic" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], env=farm.environment()).returncode == 0


def test_workers_that_start_together_upgrade_once(farm: ServerSettings) -> None:
    """Four at a time on an empty database: all succeed."""
    databases = [open_database(farm) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(upgrade_schema, databases))
    await_schema(databases[0], 0)
    for one in databases:
        one.dispose()


def test_waiting_for_a_schema_that_does_not_come_ends(farm: ServerSettings) -> None:
    database = open_database(farm)
    with pytest.raises(FailedError, match="not ready"):
        await_schema(database, 0.1)
    database.dispose()


def test_an_older_program_refuses_a_newer_database(database: sa.Engine) -> None:
    with writing(database) as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = 'from-the-future'"))
    with pytest.raises(FailedError, match="newer causticmill"):
        upgrade_schema(database)


def test_what_was_acknowledged_is_on_disk(farm: ServerSettings, database: sa.Engine) -> None:
    """SQLite: WAL, every commit synced, foreign keys kept."""
    if not farm.embedded:
        return
    with reading(database) as connection:
        found = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    assert found == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 30_000}
