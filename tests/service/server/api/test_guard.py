"""The door, tried with what no ordinary client sends: other spellings of addresses, other protocols, other callers."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path

import pytest

from service.http.admission import _MOST_CALLERS, Limiter
from service.server.api.access.guard import _WRONG_AT_ONCE
from service.server.api.access.requests import is_here
from tests.service.server.api.server import ApiServer, api_server, problem
from tests.waiting import PATIENCE_S

RUN = "0b0e7e0c-2f1d-4f6e-8f43-0a7b6a1c9d10"
BODY = b'{"operator": "Mallory", "checks": ["tool", "zero", "stock", "clear"]}'


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[ApiServer, str]]:
    """A server with tokens: nobody is anonymous any more. With it, a token that may only read."""
    with api_server(tmp_path_factory.mktemp("guard") / "data") as server:
        yield server, server.services.tokens.create("reader", ["jobs:read"])[1]


def sent(server: ApiServer, head: str, *headers: str, body: bytes = b"") -> int:
    """Status of the answer to a request of which every byte is ours."""
    lines = [head, *headers, f"Content-Length: {len(body)}", "Connection: close", "", ""]
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as wire:
        wire.sendall("\r\n".join(lines).encode("latin-1") + body)
        return int(wire.makefile("rb").readline().split()[1])


SPELLINGS = [
    "/v1/runs/{}:start", "//v1/runs/{}:start", "/v1//runs/{}:start", "/v1/./runs/{}:start", "/v1/x/../runs/{}:start",
    "/v1/runs/{}%3Astart", "/v1/runs/{}%3astart", "/%76%31/runs/{}:start", "/v1%2Fruns%2F{}:start",
    "/v1/runs/{}:start/", "/v1/runs/{}:start?x=/livez", "/v1/runs/{}:start#/livez", "/livez/../v1/runs/{}:start",
    "/livez%2f..%2fv1/runs/{}:start", "/v1/runs/{}:start;/livez", "/V1/RUNS/{}:START",
    "http://localhost/v1/runs/{}:start", "http://x/livez/v1/runs/{}:start", "/v1/runs/{}:start%00",
    "/v1/runs/{}:start%20", "/openapi.json/../v1/runs/{}:start",
]  # fmt: skip


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_no_spelling_of_an_address_gets_past_the_guard(closed: tuple[ApiServer, str], spelling: str) -> None:
    server, reader = closed
    path, kind = spelling.format(RUN), "Content-Type: application/json"
    for method in ("POST", "GET", "HEAD", "OPTIONS", "PUT", "post"):
        for caller in ((), (f"Authorization: Bearer {reader}",)):
            status = sent(server, f"{method} {path} HTTP/1.1", "Host: localhost", kind, *caller, body=BODY)
            assert status in ((400, 401) if not caller else (400, 403, 404, 405)), (method, path)


@pytest.mark.parametrize(
    ("head", "headers", "status"),
    [
        ("GET /v1/jobs HTTP/1.0", (), 403),  # no Host
        ("GET /livez HTTP/1.0", ("Host: localhost",), 401),  # as a proxy asks that says nothing of whom it asks for
        ("GET /livez HTTP/1.1", ("Host: localhost",), 200),
        ("GET /livez HTTP/1.1", ("Host: localhost", "Forwarded: for=1.2.3.4"), 401),
        ("GET /livez HTTP/1.1", ("Host: localhost", "X-Forwarded-Proto: https"), 401),
        ("GET /v1/jobs HTTP/1.1", ("Host: localhost", "Upgrade: websocket", "Connection: Upgrade"), 401),
        ("OPTIONS * HTTP/1.1", ("Host: localhost",), 401),
        ("CONNECT localhost:80 HTTP/1.1", ("Host: localhost",), 401),
        ("GET /v1/jobs HTTP/1.1", ("Host: localhost\tevil",), 403),
        ("GET /v1/jobs HTTP/1.1", ("Host: localhost", "Transfer-Encoding: chunked", "Transfer-Encoding: x"), 400),
        ("GET / HTTP/1.1", ("Host: localhost",), 200),
        ("GET / HTTP/1.1", ("Host: evil.example",), 403),
    ],
)
def test_other_ways_to_ask(closed: tuple[ApiServer, str], head: str, headers: tuple[str, ...], status: int) -> None:
    assert sent(closed[0], head, *headers) in (status, 400 if status == 401 else status)


@pytest.mark.parametrize(
    ("peer", "here"),
    [(("127.0.0.1", 1), True), (("::1", 1), True), (("127.9.9.9", 1), True), (("10.0.0.1", 1), False), (None, False),
     (("::ffff:127.0.0.1", 1), False), (("", 0), False), (("::ffff:10.0.0.1", 1), False)],
)  # fmt: skip
def test_who_is_on_this_computer(peer: tuple[str, int] | None, here: bool) -> None:
    """What is not certainly this computer is not."""
    assert is_here({"type": "http", "client": peer, "http_version": "1.1"}, {}) is here


def test_behind_a_proxy_the_figures_need_a_token(tmp_path: Path) -> None:
    """One that adds no header of its own makes strangers look like callers on this computer."""
    with api_server(tmp_path / "data", behind_proxy=True) as server:
        assert server.client.get("/livez").status_code == 200
        problem(server.client.get("/metrics"), 401)
        problem(server.client.get("/v1/jobs"), 401)
        for scopes, status in ((["jobs:read"], 403), (["admin"], 200)):
            token = server.services.tokens.create(scopes[0][:4], scopes)[1]
            answer = server.client.get("/metrics", headers={"Authorization": f"Bearer {token}"})
            assert answer.status_code == status


def test_behind_a_proxy_a_stop_needs_a_token(tmp_path: Path) -> None:
    """A mill that anybody on the network can hold is milled with by nobody."""
    with api_server(tmp_path / "data", behind_proxy=True) as server:
        runner = {"Authorization": f"Bearer {server.services.tokens.create('runner', ['machine:run'])[1]}"}
        for path in (f"/v1/runs/{RUN}:hold", "/v1/machines/none/control/abort"):
            problem(server.client.post(path), 401)
            problem(server.client.post(path, headers=runner), 404)


def test_what_is_open_to_everybody_is_not_open_without_end(tmp_path: Path) -> None:
    with api_server(tmp_path / "data", requests_per_s=1) as server:
        ask = partial(server.client.get, "/openapi.json", headers={"X-Forwarded-For": "1.2.3.4"})
        codes = iter(lambda: ask().status_code, 429)  # one a second is answered, however slow the computer is
        assert next(codes) == 200
        assert len(list(islice(codes, 60))) < 60


def test_callers_that_come_once_are_forgotten() -> None:
    limiter = Limiter(1.0, 2.0, clock=lambda: 0.0)
    for number in range(3 * _MOST_CALLERS):
        limiter.wait_s(f"peer {number}")
    assert len(limiter._buckets) == _MOST_CALLERS


@pytest.mark.parametrize("depth", [b"[" * 30_000, b'{"a":' * 10_000])
def test_depth_is_refused(closed: tuple[ApiServer, str], depth: bytes) -> None:
    server, _ = closed
    admin = server.services.tokens.create(f"a{len(depth)}", ["admin", "machine:run"])[1]
    headers = {"Authorization": f"Bearer {admin}", "Content-Type": "application/json"}
    for path in ("/v1/tokens", f"/v1/runs/{RUN}:start", "/v1/machines/m/runs"):
        assert server.client.post(path, content=depth, headers=headers).status_code in (400, 422)


@pytest.mark.parametrize("path", ["/livez", "/readyz", "/metrics"])
@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_a_foreign_page_cannot_have_health_checked(closed: tuple[ApiServer, str], path: str, site: str) -> None:
    """A picture in any page can send such a request, as often as it likes."""
    assert sent(closed[0], f"GET {path} HTTP/1.1", "Host: localhost", f"Sec-Fetch-Site: {site}") == 403
    assert sent(closed[0], f"GET {path} HTTP/1.1", "Host: localhost", "Origin: https://evil.example") == 403
    assert sent(closed[0], f"GET {path} HTTP/1.1", "Host: localhost", "Sec-Fetch-Site: none") != 403


def test_health_checks_are_charged_like_other_requests(tmp_path: Path) -> None:
    with api_server(tmp_path / "data", requests_per_s=0.01) as server:
        assert server.client.get("/livez").status_code == 200
        for path in ("/livez", "/readyz", "/metrics"):
            problem(server.client.get(path), 429)


ORIGINS = [
    ("http://localhost", True), ("HTTP://LOCALHOST", True), ("https://localhost", False), ("ftp://localhost", False),
    ("chrome-extension://localhost", False), ("http://localhost:81", False), ("http://localhost@evil.com", False),
    ("http://localhost/", False), ("null", False), ("localhost", False), ("", False),
]  # fmt: skip


@pytest.mark.parametrize(("origin", "own"), ORIGINS)
def test_an_origin_is_ours_by_scheme_name_and_port(closed: tuple[ApiServer, str], origin: str, own: bool) -> None:
    """We speak HTTP: another scheme at our name is another server. Behind a proxy pages may have come by HTTPS."""
    status = sent(closed[0], "POST /v1/jobs HTTP/1.1", "Host: localhost", f"Origin: {origin}")
    assert status == (401 if own else 403)
    proxied = ("Host: localhost", f"Origin: {origin}", "X-Forwarded-For: 192.0.2.1")
    assert sent(closed[0], "POST /v1/jobs HTTP/1.1", *proxied) == (401 if own or origin.startswith("https:") else 403)


@pytest.mark.parametrize("host", ["[::1].evil.com", "[localhost]", "localhost:80.evil.com"])
def test_a_name_that_only_begins_like_ours_is_refused(closed: tuple[ApiServer, str], host: str) -> None:
    assert sent(closed[0], "GET /v1/jobs HTTP/1.1", f"Host: {host}") == 403


def test_bogus_tokens_are_charged_before_the_database_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And neither a token that is known nor its stops pay for them."""
    with api_server(tmp_path / "data") as server:
        services, asked = server.services, []
        good = services.tokens.create("good", ["jobs:read", "machine:run"])[1]
        find = services.tokens.find
        monkeypatch.setattr(type(services.tokens), "find", lambda _, secret: asked.append(secret) or find(secret))

        def get(token: str) -> int:
            return server.client.get("/v1/jobs", headers={"Authorization": f"Bearer {token}"}).status_code

        assert get(good) == 200
        count = 3 * int(_WRONG_AT_ONCE)
        statuses = [get(f"cm_{number:043}") for number in range(count)]
        assert set(statuses) == {401, 429}
        assert len(asked) == 1 + statuses.count(401) < count
        assert get(good) == 200
        stop = {"Authorization": f"Bearer {good}", "X-Forwarded-For": "192.0.2.1"}
        asked.clear()
        assert server.client.post("/v1/machines/none/control/hold", headers=stop).status_code == 404
        assert asked == []
