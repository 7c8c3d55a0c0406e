"""New databases and upgraded ones have exactly the tables that the program uses, whichever process comes first."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from service.errors import FailedError, InputError
from service.server.database import schema
from service.server.database.connection import begin_reading, begin_writing, connect
from service.server.database.schema import HEAD, alembic_config, await_schema, open_database, upgrade_schema
from service.server.database.tables import jobs, metadata
from service.settings import ServerSettings
from tests.service.server.worker.postgres import Postgres

FIRST_TABLES = Path(__file__).with_name("tables-0006.sql")


def list_differences(database: sa.Engine) -> list[object]:
    """Return what alembic would have to change for the tables of this database to be those of `tables.py`."""
    with begin_reading(database) as connection:
        options = {"compare_type": True, "compare_server_default": True}
        found: list[object] = compare_metadata(MigrationContext.configure(connection, opts=options), metadata)
    return found


def test_a_new_database_has_the_tables_of_the_program(database: sa.Engine) -> None:
    assert list_differences(database) == []


def test_a_database_of_the_first_version_gets_the_tables_of_the_program(tmp_path: Path) -> None:
    """A change of `tables.py` without a migration fails here: databases that are kept would not get it."""
    with sqlite3.connect(tmp_path / "shop.sqlite") as kept:
        kept.executescript(FIRST_TABLES.read_text("utf-8"))
    kept.close()
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    upgrade_schema(database)
    assert list_differences(database) == []
    database.dispose()


def test_the_version_that_is_waited_for_is_the_last_migration() -> None:
    assert ScriptDirectory.from_config(alembic_config()).get_heads() == [HEAD]


@pytest.mark.thorough
def test_a_database_that_is_up_to_date_costs_no_alembic(farm: ServerSettings, database: sa.Engine) -> None:
    """It is slow to import, and the API would carry it for ever."""
    code = """
import sys
from service.server.database.jobs import JobBook
from service.server.database.job_rows import Counter, read_counters
from service.server.database.schema import await_schema, open_database
from service.settings import ServerSettings
await_schema(open_database(ServerSettings.load(), migrate=True), 0)
sys.exit("alembic" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], env=farm.environment()).returncode == 0


def test_workers_that_start_together_upgrade_once(empty_farm: ServerSettings) -> None:
    """Four at a time on an empty database: all succeed."""
    databases = [open_database(empty_farm) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(upgrade_schema, databases))
    await_schema(databases[0], 0)
    for one in databases:
        one.dispose()


def test_a_new_database_that_another_process_writes_to_is_awaited(tmp_path: Path) -> None:
    """SQLite itself waits for readers here, and refuses at once where another has begun to write."""
    path = tmp_path / "new.sqlite"
    with contextlib.closing(sqlite3.connect(path, isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")
        release = threading.Timer(0.2, other.execute, ["COMMIT"])
        release.start()
        database = connect(f"sqlite:///{path}")
        with begin_reading(database) as connection:
            assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
        database.dispose()
        release.join()


@pytest.fixture
def next_version(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Callable[[], str]:
    """Call it, and the program is the next one, whose tables have a column more; it returns its version."""

    def install() -> str:
        folder = tmp_path_factory.mktemp("next") / "migrations"
        shutil.copytree(schema.FOLDER, folder)
        (folder / "versions/v_next.py").write_text(NEXT_STEP.format(before=HEAD))
        monkeypatch.setattr(schema, "FOLDER", folder)
        monkeypatch.setattr(schema, "HEAD", "next")
        return "next"

    return install


NEXT_STEP = """
import sqlalchemy as sa
from alembic import op
revision, down_revision = "next", "{before}"
def upgrade(): op.add_column("jobs", sa.Column("colour", sa.String()))
"""


def put_job(database: sa.Engine) -> None:
    row = {"id": "j", "name": "j", "state": "failed", "priority": 1, "spec": {}, "image_sha256": "0" * 64}
    row |= {"image_bytes": 1, "created_by": "me", "created_at": 1.0, "queued_at": 1.0, "progress": 0.0}
    row |= {"cancel_requested": False, "attempt": 1, "fence": 0, "version": 1}
    with begin_writing(database) as connection:
        connection.execute(sa.insert(jobs), row)


def test_before_an_upgrade_a_copy_is_made_that_the_earlier_program_can_use(
    tmp_path: Path, next_version: Callable[[], str]
) -> None:
    """The copy has the tables and the rows of before, is whole by itself, and nobody else may read it."""
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    upgrade_schema(database)
    put_job(database)
    later = next_version()
    upgrade_schema(database)
    await_schema(database, 0)
    with begin_reading(database) as connection:
        assert connection.exec_driver_sql("SELECT id, colour FROM jobs").all() == [("j", None)]
    database.dispose()
    copy = tmp_path / f"shop.sqlite.before-{later}"
    assert copy.stat().st_mode & 0o777 == 0o600
    assert {path.name for path in tmp_path.iterdir()} == {"shop.sqlite", copy.name}
    with sqlite3.connect(copy) as before:
        assert before.execute("SELECT version_num FROM alembic_version").fetchall() == [(HEAD,)]
        assert before.execute("SELECT id FROM jobs").fetchall() == [("j",)]
        assert "colour" not in {row[1] for row in before.execute("PRAGMA table_info(jobs)")}
    before.close()


def test_a_new_database_needs_no_copy(tmp_path: Path) -> None:
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    upgrade_schema(database)
    upgrade_schema(database)
    database.dispose()
    assert [path.name for path in tmp_path.iterdir()] == ["shop.sqlite"]


def test_a_copy_that_cannot_be_made_stops_the_upgrade(tmp_path: Path, next_version: Callable[[], str]) -> None:
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    upgrade_schema(database)
    later = next_version()
    (tmp_path / f"shop.sqlite.before-{later}.part").mkdir()
    with pytest.raises(FailedError, match="cannot copy the database"):
        upgrade_schema(database)
    with pytest.raises(FailedError, match=f"version {HEAD}"):
        await_schema(database, 0)
    database.dispose()


def test_postgresql_is_upgraded_once_a_person_keeps_a_copy(postgres: Postgres, next_version: Callable[[], str]) -> None:
    """A start with the new program changes nothing that an earlier one could not use any more, until it is told to."""
    database = connect(ServerSettings(database_url=postgres.url()).sqlalchemy_url)
    upgrade_schema(database)
    put_job(database)
    later = next_version()
    for allowed in (None, HEAD):
        with pytest.raises(InputError, match=rf"pg_dump .*CAUSTICMILL_UPGRADE_TO={later}$"):
            upgrade_schema(database, allowed=allowed)
        with pytest.raises(FailedError, match=f"version {HEAD}"):
            await_schema(database, 0)
    upgrade_schema(database, allowed=later)
    await_schema(database, 0)
    database.dispose()


def test_waiting_for_a_schema_that_does_not_come_ends(empty_farm: ServerSettings) -> None:
    database = open_database(empty_farm)
    with pytest.raises(FailedError, match="not ready"):
        await_schema(database, 0.1)
    database.dispose()


@pytest.mark.parametrize("version", ["from-the-future", "0003"])
def test_a_database_of_a_version_that_is_not_known_is_refused(database: sa.Engine, version: str) -> None:
    with begin_writing(database) as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = :version"), {"version": version})
    with pytest.raises(FailedError, match=f"another causticmill: its tables have version {version}"):
        upgrade_schema(database)


def test_what_was_acknowledged_is_on_disk(farm: ServerSettings, database: sa.Engine) -> None:
    """SQLite: WAL, every commit synced, foreign keys kept."""
    if not farm.embedded:
        return
    with begin_reading(database) as connection:
        found = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    assert found == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 30_000}
