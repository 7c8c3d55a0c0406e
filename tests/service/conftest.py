"""Fixtures of everything that uses the database: each test on SQLite, and on a real PostgreSQL where there is one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import certifi
import pytest
import sqlalchemy as sa
import structlog

from service.server.database.schema import open_database
from service.settings import ServerSettings
from tests.levels import DATABASES
from tests.service import databases
from tests.service.server.worker.postgres import Postgres, missing, running_postgres


@pytest.fixture(scope="session", autouse=True)
def _one_certificate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """httpx reads all certificates for each client, which takes it longer than a request; no test needs one."""
    end = "-----END CERTIFICATE-----\n"
    path = tmp_path_factory.mktemp("tls") / "one.pem"
    path.write_text(Path(certifi.where()).read_text().partition(end)[0] + end)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SSL_CERT_FILE", str(path))
        yield


@pytest.fixture(scope="session", autouse=True)
def _plain_tracebacks() -> None:
    """As servers log: structlog's own choice, a picture of each frame, takes half a second where an answer is a 503."""
    plain = structlog.dev.ConsoleRenderer(colors=False, exception_formatter=structlog.dev.plain_traceback)
    structlog.configure(processors=[*structlog.get_config()["processors"][:-1], plain])


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A real PostgreSQL server of this session's own."""
    if reason := missing():
        pytest.skip(reason)
    with running_postgres() as server:
        yield server


@pytest.fixture(params=DATABASES)
def empty_farm(request: pytest.FixtureRequest, tmp_path: Path) -> ServerSettings:
    """Settings of a server with a database of its own, of each kind; the artifact store is a folder."""
    if request.param == "sqlite":
        return ServerSettings(data=tmp_path / "data")
    server: Postgres = request.getfixturevalue("postgres")
    return databases.on_postgres(tmp_path, server.url())


@pytest.fixture(params=DATABASES)
def farm(request: pytest.FixtureRequest, tmp_path: Path) -> ServerSettings:
    """The same with its tables, and the engine's, up to date: a copy of a database that was made once."""
    return databases.farm(request, tmp_path)


@pytest.fixture
def database(farm: ServerSettings) -> Iterator[sa.Engine]:
    """The database of `farm`."""
    opened = open_database(farm)
    yield opened
    opened.dispose()
