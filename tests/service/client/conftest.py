"""Two job servers for all tests of the client, and the command as a person runs it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.client.shop import ShopWithoutWorker, ShopWithWorker
from tests.service.server.api.server import api_server
from tests.trials.server.deployment import embedded


@pytest.fixture(scope="session")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ShopWithoutWorker]:
    """A server that runs, and a folder for its customers."""
    folder = tmp_path_factory.mktemp("shop")
    with api_server(folder / "data") as server:
        yield ShopWithoutWorker(server.address, folder, server)


@pytest.fixture(scope="session")
def working_shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ShopWithWorker]:
    """One whose jobs are computed."""
    folder = tmp_path_factory.mktemp("working-shop")
    with embedded(folder) as deployment:
        yield ShopWithWorker(deployment.url, folder, deployment)


@pytest.fixture(autouse=True)
def _nobody_s_settings(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not those of whoever runs the tests; a shop with a mill has its own."""
    for name in ("CAUSTICMILL_SERVER", "CAUSTICMILL_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    if "mill_shop" not in request.fixturenames:
        monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "config"))
