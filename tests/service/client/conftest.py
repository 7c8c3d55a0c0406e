"""One real job server for all tests of the client, and the command as a person runs it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.client.shop import Shop
from tests.trials.server.deployment import embedded


@pytest.fixture(scope="session")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    """A server that runs, and a folder for its customers."""
    folder = tmp_path_factory.mktemp("shop")
    with embedded(folder) as deployment:
        yield Shop(deployment, folder)


@pytest.fixture(autouse=True)
def _nobody_s_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not those of whoever runs the tests."""
    for name in ("CAUSTICMILL_SERVER", "CAUSTICMILL_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "config"))
