"""Databases with their tables up to date, those of jobs and those of the engine: migrated once, then copied."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import psycopg
import pytest

from service.server.database.connection import connect
from service.server.database.schema import upgrade_schema
from service.server.queue.dbos import DbosEngine
from service.settings import ServerSettings
from tests.service.server.worker.postgres import Postgres

_TEMPLATE = "migrated"
_ENGINE = "engine.sqlite"


def copy_to(settings: ServerSettings, *, engine: bool = True) -> None:
    """New SQLite files in the data folder. engine: those of a server on which a worker has been started before"""
    settings.data.mkdir(parents=True, exist_ok=True)
    for name, content in _made().items():
        if engine or name != _ENGINE:
            path = settings.data / name
            path.write_bytes(content)
            path.chmod(0o600)


def copy_on(server: Postgres) -> str:
    """URL of a new database on this server."""
    with psycopg.connect(server.url_of("postgres"), autocommit=True) as connection:
        found = connection.execute("SELECT 1 FROM pg_database WHERE datname = %s", [_TEMPLATE]).fetchone()
    if found is None:
        _migrate(on_postgres(Path("/nowhere"), server.url(_TEMPLATE)))
    return server.url(template=_TEMPLATE)


def on_postgres(folder: Path, url: str) -> ServerSettings:
    return ServerSettings(
        data=folder / "data", database_url=url, store_url=(folder / "store").as_uri(), store_is_shared=True
    )


def farm(request: pytest.FixtureRequest, folder: Path) -> ServerSettings:
    """For a fixture with the parameters "sqlite" and "postgresql"."""
    if request.param == "sqlite":
        settings = ServerSettings(data=folder / "data")
        copy_to(settings)
        return settings
    return on_postgres(folder, copy_on(request.getfixturevalue("postgres")))


@cache
def _made() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        _migrate(ServerSettings(data=Path(folder)))
        return {path.name: path.read_bytes() for path in Path(folder).glob("*.sqlite")}


def _migrate(settings: ServerSettings) -> None:
    database = connect(settings.sqlalchemy_url)
    upgrade_schema(database)
    database.dispose()
    DbosEngine(settings).prepare()
