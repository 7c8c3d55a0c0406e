"""Bodies that come slowly, or grow too long."""

from __future__ import annotations

import asyncio

import pytest
from starlette.requests import Request
from starlette.types import Message

from service.http.problems import Problem
from service.server.api.intake.form import RequestBody
from tests.service.server.api.server import ApiServer


def test_a_client_that_stops_sending_is_given_up() -> None:
    async def silence() -> Message:
        await asyncio.sleep(60)
        raise AssertionError

    async def read() -> None:
        body = RequestBody(Request({"type": "http", "headers": []}, silence), wait_s=0.01)
        async for _ in body.pieces():
            raise AssertionError

    with pytest.raises(Problem, match="nothing came") as told:
        asyncio.run(read())
    assert told.value.status == 408


@pytest.mark.parametrize("path", ["/v1/tokens", "/v1/machines/mill/runs"])
def test_a_json_body_is_small(server: ApiServer, path: str) -> None:
    answer = server.client.post(path, content=b'{"a": "' + b"x" * 200_000, headers={"Content-Type": "application/json"})
    assert answer.status_code in (401, 413)
    assert answer.headers["content-type"] == "application/problem+json"
