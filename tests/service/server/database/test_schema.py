"""The migrations lead to exactly the tables that the program uses, on both databases, whoever comes first."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from service.errors import FailedError, InputError
from service.server.database.connection import begin_reading, begin_writing, connect
from service.server.database.job_rows import Counter, read_counters
from service.server.database.jobs import JobBook
from service.server.database.schema import HEAD, alembic_config, await_schema, open_database, upgrade_schema
from service.server.database.tables import jobs, metadata, result_files
from service.settings import ServerSettings
from tests.service.server.worker.postgres import Postgres


def test_migrations_and_tables_agree(database: sa.Engine) -> None:
    """Nothing is left to do for alembic after an upgrade."""
    with begin_reading(database) as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []


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


def put_at(database: sa.Engine, version: str) -> None:
    """Tables as an earlier program made them."""
    config = alembic_config()
    with begin_writing(database) as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, version)


def put_job(database: sa.Engine) -> None:
    # only columns that the first version had
    row = {"id": "j", "name": "j", "state": "failed", "priority": 1, "spec": {}, "image_sha256": "0" * 64}
    row |= {"image_bytes": 1, "created_by": "me", "created_at": 1.0, "queued_at": 1.0, "progress": 0.0}
    row |= {"cancel_requested": False, "attempt": 1, "fence": 0, "version": 1}
    columns = {column.name: column for column in jobs.columns if column.name in row}
    with begin_writing(database) as connection:
        connection.execute(sa.insert(sa.table("jobs", *(sa.column(n, c.type) for n, c in columns.items()))), row)


def test_before_an_upgrade_a_copy_is_made_that_the_earlier_program_can_use(tmp_path: Path) -> None:
    """The copy has the tables and the rows of before, is whole by itself, and nobody else may read it."""
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    put_at(database, "0002")
    put_job(database)
    upgrade_schema(database)
    await_schema(database, 0)
    database.dispose()
    copy = tmp_path / f"shop.sqlite.before-{HEAD}"
    assert copy.stat().st_mode & 0o777 == 0o600
    assert {path.name for path in tmp_path.iterdir()} == {"shop.sqlite", copy.name}
    with sqlite3.connect(copy) as before:
        assert before.execute("SELECT version_num FROM alembic_version").fetchall() == [("0002",)]
        assert before.execute("SELECT id FROM jobs").fetchall() == [("j",)]
        assert "wrong" in {row[1] for row in before.execute("PRAGMA table_info(pairings)")}
    before.close()


def test_a_new_database_needs_no_copy(tmp_path: Path) -> None:
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    upgrade_schema(database)
    upgrade_schema(database)
    database.dispose()
    assert [path.name for path in tmp_path.iterdir()] == ["shop.sqlite"]


def test_a_copy_that_cannot_be_made_stops_the_upgrade(tmp_path: Path) -> None:
    database = connect(f"sqlite:///{tmp_path / 'shop.sqlite'}")
    put_at(database, "0002")
    (tmp_path / f"shop.sqlite.before-{HEAD}.part").mkdir()
    with pytest.raises(FailedError, match="cannot copy the database"):
        upgrade_schema(database)
    with pytest.raises(FailedError, match="version 0002"):
        await_schema(database, 0)
    database.dispose()


def test_postgresql_is_upgraded_once_a_person_keeps_a_copy(postgres: Postgres) -> None:
    """A start with the new program changes nothing that an earlier one could not use any more, until it is told to."""
    database = connect(ServerSettings(database_url=postgres.url()).sqlalchemy_url)
    put_at(database, "0002")
    put_job(database)
    for allowed in (None, "0002"):
        with pytest.raises(InputError, match=rf"pg_dump .*CAUSTICMILL_UPGRADE_TO={HEAD}$"):
            upgrade_schema(database, allowed=allowed)
        with pytest.raises(FailedError, match="version 0002"):
            await_schema(database, 0)
    upgrade_schema(database, allowed=HEAD)
    await_schema(database, 0)
    database.dispose()


def test_waiting_for_a_schema_that_does_not_come_ends(empty_farm: ServerSettings) -> None:
    database = open_database(empty_farm)
    with pytest.raises(FailedError, match="not ready"):
        await_schema(database, 0.1)
    database.dispose()


def test_an_older_program_refuses_a_newer_database(database: sa.Engine) -> None:
    with begin_writing(database) as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = 'from-the-future'"))
    with pytest.raises(FailedError, match="newer causticmill"):
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


def test_an_older_database_is_brought_up_to_date_with_what_is_in_it(empty_farm: ServerSettings) -> None:
    """From version 0003: the counters and the files of results are what a count of the old rows gives."""
    database = open_database(empty_farm)
    config = alembic_config()
    with begin_writing(database) as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0003")
        for statement in OLD_ROWS:
            connection.exec_driver_sql(statement)
    upgrade_schema(database, allowed=HEAD)
    with begin_reading(database) as connection:
        assert read_counters(connection) == {
            Counter("jobs", state="succeeded"): 2,
            Counter("jobs", state="queued"): 1,
            Counter("stage_runs", "map", "committed"): 2,
            Counter("stage_runs", "map", "interrupted"): 1,
            Counter("stage_seconds", "map", "committed"): 8.0,
            Counter("stage_results"): 2,
        }
        files = connection.execute(sa.select(result_files).order_by(result_files.c.sha256)).all()
        assert [tuple(row) for row in files] == [("k1", "a.png", "aa"), ("k1", "b.npz", "bb")]
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []
    assert [job.id for job in JobBook(database).list_rows()] == ["j3", "j2", "j1"]
    database.dispose()


def _old_job(number: int, state: str) -> str:
    return (
        "INSERT INTO jobs (id, name, state, priority, spec, image_sha256, image_bytes, created_by, created_at, "
        "queued_at, progress, cancel_requested, attempt, fence, version) VALUES "
        f"('j{number}', 'a', '{state}', 100, '{{}}', 'ii', 1, 'me', {number}, {number}, 0, false, 1, 0, 1)"
    )


def _old_try(job: int, state: str, ended_at: str) -> str:
    return (
        "INSERT INTO stage_runs (job_id, attempt, number, stage, state, key, executor, fence, started_at, ended_at) "
        f"VALUES ('j{job}', 1, 1, 'map', '{state}', 'k1', 'w', 1, 10, {ended_at})"
    )


def _old_result(key: str, outputs: str) -> str:
    return (
        "INSERT INTO stage_results (key, stage, outputs, report, notes, seconds, peak_rss_mb, job_id, created_at, "
        f"used_at) VALUES ('{key}', 'map', '{outputs}', '{{}}', '{{}}', 1, 1, 'j1', 1, 1)"
    )


OLD_ROWS = (
    _old_job(1, "succeeded"), _old_job(2, "succeeded"), _old_job(3, "queued"),
    _old_try(1, "committed", "15"), _old_try(2, "committed", "13"), _old_try(2, "interrupted", "12"),
    _old_try(3, "running", "NULL"),
    _old_result("k1", '{"a.png": {"sha256": "aa", "bytes": 1}, "b.npz": {"sha256": "bb", "bytes": 2}}'),
    _old_result("k2", "{}"),
)  # fmt: skip
