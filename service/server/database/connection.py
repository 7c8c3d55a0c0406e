"""The connection to the database, and the few statements in which SQLite and PostgreSQL differ.

All access is SQLAlchemy Core, the same code for both. Every change is made in `begin_writing`: on SQLite that takes
the write lock at once (a read transaction that turns into a write can fail at any moment), on PostgreSQL each change
locks the rows that it concerns.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from service.errors import FailedError

BUSY_TIMEOUT_S = 30
LOCK_POLL_S = 0.002
CONNECT_TIMEOUT_S = 5


def connect(url: str) -> sa.Engine:
    """Return an engine of SQLAlchemy for a database of ours, SQLite or PostgreSQL."""
    if url.startswith("sqlite"):
        engine = sa.create_engine(url, json_serializer=_as_json, connect_args={"timeout": BUSY_TIMEOUT_S})
        sa.event.listen(engine, "connect", _prepare_sqlite)
        sa.event.listen(engine, "begin", _begin_sqlite)
        return engine
    # Keepalives: the loss of a host is noticed in about 25 s rather than in hours.
    connect_args = {"connect_timeout": CONNECT_TIMEOUT_S, "keepalives_idle": 10, "keepalives_interval": 5}
    return sa.create_engine(
        url, json_serializer=_as_json, pool_pre_ping=True, pool_timeout=BUSY_TIMEOUT_S, connect_args=connect_args
    )


def copy_sqlite(source: Path, target: Path) -> None:
    """Copy a database that is in use, by SQLite's own backup: it neither waits for writers nor stops them.

    Only the account itself can read the new file. FailedError.
    """
    try:
        os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600))
        with (
            contextlib.closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=rw", uri=True, timeout=30)) as old,
            contextlib.closing(sqlite3.connect(target)) as new,
        ):
            old.backup(new)
    except (sqlite3.Error, OSError) as error:
        raise FailedError(f"cannot copy the database {source}: {error}") from None


def use_wal(connection: sqlite3.Connection) -> None:
    """Let readers and a writer of a database work concurrently; the setting is stored in the file.

    SQLite does not resolve two simultaneous changes of the mode: each holds the lock that the other needs, and one
    fails.
    """
    if connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
        _ask_until_unlocked(lambda: connection.execute("PRAGMA journal_mode = WAL"))


def is_sqlite(bind: sa.Engine | sa.Connection) -> bool:
    return bind.dialect.name == "sqlite"


@contextmanager
def begin_reading(database: sa.Engine) -> Iterator[sa.Connection]:
    """Begin a transaction that changes nothing."""
    with database.connect() as connection, connection.begin():
        yield connection


@contextmanager
def begin_writing(database: sa.Engine) -> Iterator[sa.Connection]:
    """Begin a transaction that writes: all its changes are on disk when it ends without an exception; otherwise none
    is.
    """
    with database.connect().execution_options(writes=True) as connection, connection.begin():
        yield connection


def clock(connection: sa.Connection) -> float:
    """Return seconds since 1970 by the database's clock, the only one that hosts of a farm share."""
    if is_sqlite(connection):
        return time.time()
    return float(connection.execute(sa.text("SELECT extract(epoch FROM clock_timestamp())")).scalar_one())


def insert_new(connection: sa.Connection, table: sa.Table, values: Mapping[str, Any]) -> bool:
    """Insert a row; do nothing and return False if its key exists already."""
    insert = sqlite.insert if is_sqlite(connection) else postgresql.insert
    new = insert(table).values(**values).on_conflict_do_nothing().returning(sa.literal(1))
    return connection.execute(new).first() is not None


def put_rows(connection: sa.Connection, table: sa.Table, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows; one whose primary key is there already replaces it."""
    keys = [column.name for column in table.primary_key.columns]
    for row in rows:
        insert = (sqlite.insert if is_sqlite(connection) else postgresql.insert)(table).values(**row)
        others = {name: value for name, value in row.items() if name not in keys}
        connection.execute(insert.on_conflict_do_update(index_elements=keys, set_=others))


def _as_json(value: object) -> str:
    """Return strict JSON: PostgreSQL takes no NaN, and neither do clients."""
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _prepare_sqlite(connection: Any, _record: object) -> None:
    # No implicit transactions by the driver: `_begin_sqlite` begins them.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_S * 1000}")
    use_wal(connection)
    cursor.execute("PRAGMA synchronous = FULL")
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()


def _begin_sqlite(connection: sa.Connection) -> None:
    if connection.get_execution_options().get("writes", False):
        _take_write_lock(connection)
    else:
        connection.exec_driver_sql("BEGIN")


def _take_write_lock(connection: sa.Connection) -> None:
    """Ask for the lock every 2 ms: SQLite's own wait backs off to 100 ms, and others overtake it all the time."""
    connection.exec_driver_sql("PRAGMA busy_timeout = 0")
    try:
        _ask_until_unlocked(lambda: connection.exec_driver_sql("BEGIN IMMEDIATE"))
    finally:
        connection.exec_driver_sql(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_S * 1000}")


def _ask_until_unlocked(ask: Callable[[], object]) -> None:
    give_up = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        try:
            ask()
            return
        except (sqlite3.OperationalError, sa.exc.OperationalError) as error:
            if "locked" not in str(error) or time.monotonic() > give_up:
                raise
        time.sleep(LOCK_POLL_S)
