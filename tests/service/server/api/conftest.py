"""One running server for the tests that leave nothing behind which disturbs others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.server.api.server import ApiServer, api_server


@pytest.fixture(scope="package")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApiServer]:
    data: Path = tmp_path_factory.mktemp("api") / "data"
    with api_server(data, max_upload_mb=2, max_megapixels=4) as running:
        yield running
