"""What answers at the address itself, and what stands in every answer."""

from __future__ import annotations

import socket
from importlib import metadata

import httpx
import pytest

from tests.service.server.api.server import ApiServer
from tests.waiting import PATIENCE_S

VERSION = metadata.version("causticmill")


def test_the_root_tells_what_is_here_and_where_the_rest_is(server: ApiServer) -> None:
    told = server.client.get("/").json()
    assert (told["name"], told["version"]) == ("causticmill", VERSION)
    for path in told["links"].values():
        assert server.client.get(path).status_code in (200, 401, 503), path


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [("GET", "/livez", 200), ("GET", "/nowhere", 404), ("PUT", "/livez", 405), ("GET", "/v1/jobs?limit=x", 422)],
)
def test_every_answer_tells_the_version(server: ApiServer, method: str, path: str, status: int) -> None:
    answer = server.client.request(method, path)
    assert (answer.status_code, answer.headers.get_list("causticmill-version")) == (status, [VERSION])


def test_what_the_guard_and_the_wire_refuse_tells_the_version_too(server: ApiServer) -> None:
    assert (
        httpx.get(f"{server.address}/livez", headers={"Host": "evil"}, timeout=PATIENCE_S).headers[
            "causticmill-version"
        ]
        == VERSION
    )
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as wire:
        wire.sendall(b"this is no request\r\n\r\n")
        answer = wire.makefile("rb").read().decode()
    assert answer.startswith("HTTP/1.1 400") and f"causticmill-version: {VERSION}" in answer.lower()
