"""Real stores: a folder, and an S3 server of our own on loopback."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.settings import ServerSettings
from service.store.base import Store
from service.store.opening import open_store
from tests.waiting import PATIENCE_S

_BUCKET = "causticmill-tests"
_AWS = {
    "AWS_ACCESS_KEY_ID": "tester",
    "AWS_SECRET_ACCESS_KEY": "not-a-secret",
    "AWS_REGION": "us-east-1",
    "NO_PROXY": "127.0.0.1",
}


@pytest.fixture(scope="session")
def s3_address() -> Iterator[str]:
    """A server of the S3 protocol with an empty bucket; the AWS_... variables of this process lead to it."""
    from moto.server import ThreadedMotoServer  # slow to import: for who asks for it

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    before = dict(os.environ)
    os.environ.update(_AWS | {"AWS_ENDPOINT_URL": f"http://{host}:{port}"})
    try:
        yield f"http://{host}:{port}"
    finally:
        os.environ.clear()
        os.environ.update(before)
        server.stop()


@pytest.fixture(scope="session")
def s3_urls(s3_address: str) -> Iterator[str]:
    """A fresh prefix in the bucket, each time one is asked for."""
    import httpx

    httpx.put(f"{s3_address}/{_BUCKET}", trust_env=False, timeout=PATIENCE_S).raise_for_status()
    return (f"s3://{_BUCKET}/trial-{number}" for number in itertools.count())


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    url = None if request.param == "folder" else next(request.getfixturevalue("s3_urls"))
    return open_store(ServerSettings(data=tmp_path / "data", store_url=url))


@pytest.fixture
def written(tmp_path: Path) -> Callable[[bytes], Path]:
    """Files on the file system of the store in a folder."""
    numbers = itertools.count()

    def write(content: bytes) -> Path:
        path = tmp_path / f"file-{next(numbers)}"
        path.write_bytes(content)
        return path

    return write
