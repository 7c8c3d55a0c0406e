"""Fixtures of everything that uses the database: each test on SQLite, and on a real PostgreSQL where there is one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from service.jobs.database import open_database
from service.settings import ServerSettings
from tests.service.worker.postgres import Postgres, missing, running_postgres


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A real PostgreSQL server of this session's own."""
    if reason := missing():
        pytest.skip(reason)
    with running_postgres() as server:
        yield server


@pytest.fixture(params=["sqlite", "postgresql"])
def farm(request: pytest.FixtureRequest, tmp_path: Path) -> ServerSettings:
    """Settings of a server with a database of its own, of each kind; the artifact store is a folder."""
    if request.param == "sqlite":
        return ServerSettings(data=tmp_path / "data")
    server: Postgres = request.getfixturevalue("postgres")
    store = tmp_path / "store"
    return ServerSettings(
        data=tmp_path / "data", database_url=server.url(), store_url=store.as_uri(), store_is_shared=True
    )


@pytest.fixture
def database(farm: ServerSettings) -> Iterator[sa.Engine]:
    """The database of `farm`, its tables up to date."""
    opened = open_database(farm, migrate=True)
    yield opened
    opened.dispose()
