"""Connections that want nothing, or want it slowly: they cost those that work nothing."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import resource
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import Message, Receive, Scope, Send

from service.http.admission import Admission
from service.http.problems import Problem
from service.server.api.access.requests import BodyLimits
from service.server.api.intake.form import RequestBody, Space
from tests.service.server.api.server import ApiServer, api_server, png, problem
from tests.waiting import PATIENCE_S, seen, until


def opened(server: ApiServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S)


def read_until(wire: socket.socket, end: bytes) -> bytes:
    got = b""
    while not got.endswith(end):
        got += wire.recv(1)
    return got


@pytest.fixture
def many_files() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = hard if hard != resource.RLIM_INFINITY else 30_000
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 30_000), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.thorough
def test_idle_connections_make_room_for_those_that_ask(server: ApiServer, many_files: None) -> None:
    """Ten times as many as are allowed: every request in between is answered, and few of them are still open."""
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(opened(server)) for _ in range(3000)]
        for _ in range(20):
            assert httpx.get(f"{server.address}/livez", timeout=PATIENCE_S).status_code == 200
            idle += [stack.enter_context(opened(server)) for _ in range(50)]
        until(lambda: len(server.server.server_state.connections) <= 1001)


@pytest.fixture
def small(tmp_path: Path) -> Iterator[tuple[ApiServer, dict[str, str]]]:
    """A server with few places and little time; with it, what a known caller says of itself."""
    places = Admission(most=8, strangers=3, wait_s=2.0)
    with api_server(tmp_path / "data", admission=places) as server:
        secret = server.services.tokens.create("known", ["jobs:read", "jobs:write", "machine:run"])[1]
        yield server, {"Authorization": f"Bearer {secret}"}


def stop(server: ApiServer, headers: dict[str, str]) -> int:
    """404: admitted, and there is no such mill."""
    path = f"{server.address}/v1/machines/none/control/hold"
    return httpx.post(path, headers=headers, timeout=PATIENCE_S).status_code


BODY = (
    b"POST /v1/pairings HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"  # open to everybody
    b"Content-Length: 1000\r\n\r\nx"
)
SOCKET = (
    b"GET /v1/stops HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nX-Forwarded-For: 192.0.2.1\r\n\r\n"
)


@pytest.mark.parametrize("words", [b"", BODY[:40], BODY, SOCKET], ids=["silence", "half a head", "body", "socket"])
def test_strangers_take_no_place_of_those_who_are_known_and_of_stops(
    small: tuple[ApiServer, dict[str, str]], words: bytes
) -> None:
    """Whatever they leave unsaid: the oldest of them are closed."""
    server, known = small
    with contextlib.ExitStack() as stack, httpx.Client(base_url=server.address, timeout=PATIENCE_S) as kept:
        assert kept.get("/v1/jobs", headers=known).status_code == 200
        for _ in range(30):
            stack.enter_context(opened(server)).sendall(words)
        until(lambda: server.admission.count <= 1 + 3)
        assert stop(server, known) == 404 and stop(server, {}) == 404
        assert kept.get("/v1/jobs", headers=known).status_code == 200


@pytest.mark.parametrize("words", [BODY, SOCKET], ids=["body", "socket"])
def test_a_connection_that_is_lost_leaves_its_place(small: tuple[ApiServer, dict[str, str]], words: bytes) -> None:
    server, _ = small
    server.admission.wait_s = 1e6
    with opened(server) as wire:
        wire.sendall(words)
        until(lambda: server.admission.count == 1)
        if words == SOCKET:
            assert b"101" in read_until(wire, b"\r\n\r\n")
    until(lambda: server.admission.count == 0)


@pytest.mark.parametrize("words", [BODY, SOCKET], ids=["body", "socket"])
def test_no_byte_renews_a_strangers_time(small: tuple[ApiServer, dict[str, str]], words: bytes) -> None:
    server, _ = small
    with opened(server) as wire:
        wire.sendall(words)

        def drips() -> bool:
            with contextlib.suppress(OSError):
                wire.sendall(b"x" if words == BODY else bytes.fromhex("8980") + b"mask")  # a ping is no token
                return True
            return False

        seen(drips, lambda alive: not alive, every_s=0.1)


def test_a_slow_body_of_a_known_caller_is_waited_for(small: tuple[ApiServer, dict[str, str]]) -> None:
    """Longer than a stranger's."""
    server, known = small
    with opened(server) as wire:
        token = f"Authorization: {known['Authorization']}\r\nContent-Type: application/json"
        wire.sendall(f"PUT /v1/tools HTTP/1.1\r\nHost: localhost\r\n{token}\r\nContent-Length: 7\r\n\r\n".encode())
        time.sleep(1.5 * server.admission.wait_s)
        wire.sendall(b"no JSON")
        assert wire.recv(12)[:10] == b"HTTP/1.1 4"


def test_where_all_connections_are_at_work_others_are_told_so_and_stops_arrive(
    small: tuple[ApiServer, dict[str, str]],
) -> None:
    server, known = small
    job = server.submit(headers=known)["id"]
    server.client.close()
    token = f"Authorization: {known['Authorization']}"
    with contextlib.ExitStack() as stack, httpx.Client(base_url=server.address, timeout=PATIENCE_S) as late:
        for _ in range(server.admission.most):
            wire = stack.enter_context(opened(server))
            wire.sendall(f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: localhost\r\n{token}\r\n\r\n".encode())
            assert wire.recv(12) == b"HTTP/1.1 200"
        assert "requests" in problem(late.get("/livez"), 503)["detail"]
        assert stop(server, known) == 404
    until(lambda: httpx.get(f"{server.address}/livez", timeout=PATIENCE_S).status_code == 200)


@pytest.mark.parametrize("before", [b"", b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n"])
def test_half_a_head_is_not_waited_for(small: tuple[ApiServer, dict[str, str]], before: bytes) -> None:
    """Neither in a new connection nor after an answer."""
    with opened(small[0]) as wire:
        if before:
            wire.sendall(before)
            assert b"200" in read_until(wire, b"}")
        wire.sendall(b"GET /livez HTTP/1.1\r\nHost:")
        with contextlib.suppress(ConnectionResetError):
            assert wire.recv(4096) == b""


def test_a_download_under_way_is_not_taken_for_silence(small: tuple[ApiServer, dict[str, str]]) -> None:
    server, known = small
    job = server.submit(headers=known)["id"]
    token = f"Authorization: {known['Authorization']}"
    with opened(server) as wire:
        wire.sendall(f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: localhost\r\n{token}\r\n\r\n".encode())
        time.sleep(1.5 * server.admission.wait_s)  # longer than one that asks for nothing is waited for
        server.client.delete(f"/v1/jobs/{job}", headers=known).raise_for_status()
        assert wire.makefile("rb").read().endswith(b"0\r\n\r\n")


def test_a_body_that_stops_coming_and_a_reader_that_stops_reading_are_given_up() -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"] == "/body":
            await receive()
        else:
            await send({"type": "http.response.start", "status": 200})

    async def never(_: Message | None = None) -> Message:
        await asyncio.sleep(60)
        raise AssertionError

    patient = BodyLimits(app, but=re.compile("/body"), piece_s=0.01, taken_s=0.01)
    for path, error in (("/body", HTTPException), ("/", TimeoutError)):
        with pytest.raises(error):
            asyncio.run(patient({"type": "http", "method": "POST", "path": path}, never, never))  # type: ignore[arg-type]


def test_uploads_that_fill_the_disk_are_stopped_on_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many may come at once, so the space is looked at while they come, and nothing of them stays."""
    with api_server(tmp_path / "data", free_disk_mb=500) as server:
        left = iter([10_000.0, 10_000.0, 1.0])
        monkeypatch.setattr(Space, "_free_mb", lambda _: next(left, 1.0))
        answer = server.client.post("/v1/jobs", files={"image": b"\x89PNG" + b"x" * 12_000_000})
        problem(answer, 507)
        assert server.files() == set()


def test_a_job_whose_programs_the_disk_cannot_hold_is_refused_at_once(server: ApiServer) -> None:
    """20 passes over a lens of 2 m at the finest pitch are hundreds of terabytes."""
    finest = {"radius_mm": 0.5, "pitch_mm": 0.002, "name": "finish"}
    passes = [finest | {"name": f"p{number}"} for number in range(20)]
    travel = {"travel_mm": [3000, 3000, 300]}
    spec = {"optics": {"width_mm": 2000, "height_mm": 2000}, "passes": passes, "machine": travel}
    before = server.files()
    answer = server.client.post("/v1/jobs", files={"image": png()}, data={"spec": json.dumps(spec)})
    assert "MB" in problem(answer, 507, "spec.passes")["detail"]
    assert server.files() == before


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
