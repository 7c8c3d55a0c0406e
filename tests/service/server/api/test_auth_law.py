"""The law: without a valid token that has machine:run, no request to any route moves a mill.

Tried on every route that the app has, so that a new one is covered from its first day, against a real agent and a
simulated mill that keeps every byte it hears. A parked run, which one good request would start, waits all the while.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import httpx
import pytest

from machines.mill.orders import Stop
from machines.simulated import SimulatedMill
from machines.simulated.endpoints import serve_pty
from service.http.admission import STOPS
from service.server.api.access import guard
from service.server.api.app import make_app
from service.server.database.connection import begin_writing
from service.server.database.tables import tokens
from tests.service.mills import AT_ZERO, Bench, ends
from tests.service.server.api.server import png
from tests.service.server.fleet.shop import CHECKS, MACHINE, Shop, give, kill_agents, own_folders, shop, write_profile
from tests.waiting import PATIENCE_S

ORDERS: dict[str, dict[str, Any]] = {
    "jog": {"by_mm": [1.0, 0.0, 0.0]},
    "probe": {"depth_mm": 5},
    "probe-corner": dict.fromkeys(
        ("depth_mm", "plate_mm", "wall_x_mm", "wall_y_mm", "cutter_radius_mm", "margin_mm"), 3
    ),
    "go-to-zero": {"axes": "XY"},
    "frame": {"program": "0" * 64},
    "zero": {},
    "override": {"what": "feed", "percent": 90},
    "spindle": {"on": True, "rpm": 9000},
    "check": {"on": True},
    "block": {"text": "G0 X1"},
} | {order: {} for order in ("home", "unlock", "reset", "resume", "trust-position", "settings", *map(str, Stop))}
OTHERS = ("jobs:read", "jobs:write", "admin")
REFUSED = (400, 401, 403, 421)


class ListeningMill(SimulatedMill):
    """Keeps what it is told."""

    heard = b""

    def receive(self, data: bytes, at_s: float | None = None) -> None:
        self.heard += data
        super().receive(data, at_s)


@dataclass
class Guarded:
    """A shop with a parked run. `good` is a token that may start it, `spare` the id of one that nobody needs."""

    floor: Shop
    mill: ListeningMill
    run: dict[str, Any]
    good: str
    spare: str

    def every_request(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Method, address and content of a request to each route: such as would be right with the right token."""
        for method, path in routes(self.floor):
            yield method, self._address(path), self._content(method, path)

    def _address(self, path: str) -> str:
        whose = self.spare if "/tokens/" in path else self.run["id" if path.startswith("/v1/runs") else "job"]
        parts = {"{id:uuid}": whose, "{id}": whose, "{machine}": MACHINE, "{path:path}": "index.html"}
        parts |= {"{name}": "pass-1-rough.nc", "{n}": "1", "{n:int}": "1", "{profile}": "unknown"}
        for part, value in parts.items():
            path = path.replace(part, value)
        assert "{" not in path, f"{path}: say here what to put there"
        return path

    def _content(self, method: str, path: str) -> dict[str, Any]:
        if method not in ("POST", "PUT", "PATCH"):
            return {}
        if path == "/v1/jobs":
            return {"files": {"image": ("p.png", png())}}
        if path.endswith("/runs"):
            return {"json": {"job": self.run["job"], "program": 1}}
        if path == "/v1/tokens":
            return {"json": {"name": f"n{time.monotonic_ns()}", "scopes": ["machine:run"]}}
        if path.endswith((":start", ":recover")):
            return {"json": {"operator": "Mallory", "checks": [*CHECKS, "position", "order"]}}
        if path == "/v1/pairings":
            return {"json": {"code": "0000-0000-0000", "name": "Mallory"}}
        if path.endswith("/control"):
            return {"json": {"operator": "Mallory", "take_over": True}}
        return {"json": ORDERS.get(path.rpartition("/")[2], {})}


def routes(floor: Shop) -> list[tuple[str, str]]:
    """Method and path of every route, those that the OpenAPI document does not show included."""
    return sorted(set(_flat(make_app(floor.server.services).routes)))


def _flat(found: Iterable[Any]) -> Iterator[tuple[str, str]]:
    for route in found:
        if hasattr(route, "original_router"):
            assert not route.include_context.prefix
            yield from _flat(route.original_router.routes)
        else:  # whatever has neither methods nor a path is of a kind that this test does not know: it shall fail
            yield from ((method, route.path) for method in route.methods)


def moves_mills(method: str, path: str) -> bool:
    return method == "POST" and path.startswith(("/v1/runs/", "/v1/machines/"))


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    folder = tmp_path_factory.mktemp("law")
    mill = ListeningMill(AT_ZERO)
    with pytest.MonkeyPatch.context() as patch, serve_pty(mill, 8.0) as endpoint:
        own_folders(patch, folder)
        write_profile(endpoint.url)
        patch.setattr(guard, "_WRONG_AT_ONCE", 1e6)  # each request is judged by itself, however many there are
        try:
            with shop(folder / "data", Bench(mill, endpoint.url, endpoint, 8.0)) as floor:
                run = floor.park(floor.job((60,)))
                spare, _ = floor.server.services.tokens.create("spare", ["jobs:read"])
                yield Guarded(floor, mill, run, floor.token("machine:run", "jobs:read"), spare.id)
        finally:
            kill_agents(folder)


@pytest.fixture
def untouched(guarded: Guarded) -> Iterator[Guarded]:
    """Whatever a test does: the mill has heard nothing but questions, stands where it stood, and the run waits."""
    heard, place = len(guarded.mill.heard), guarded.mill.physical_mm
    yield guarded
    told = guarded.floor.get(f"/v1/runs/{guarded.run['id']}")
    assert (told["state"], told["open"], told["unreachable"]) == ("parked", True, False)
    assert set(guarded.mill.heard[heard:]) <= set(b"?"), guarded.mill.heard[heard:]
    assert guarded.mill.physical_mm == place and guarded.floor.bench.cut == []
    assert len(guarded.floor.get("/v1/runs")["runs"]) == 1
    holders = [
        token.name for token in guarded.floor.server.services.tokens.list_rows() if "machine:run" in token.scopes
    ]
    assert not [name for name in holders if name.startswith("n")]


def send_all(
    guarded: Guarded,
    headers: Any = None,
    params: dict[str, str] | None = None,
    methods: str = "",
    but: tuple[str, ...] = (),
) -> None:
    """A request to every route, as if from another computer; those that move mills are refused.

    From this computer everybody may stop a mill. but : ends of addresses that are not asked
    """
    own = {"Connection": "close", "X-Forwarded-For": "192.0.2.1"}
    with httpx.Client(base_url=guarded.floor.server.address, timeout=PATIENCE_S, headers=own) as client:
        for method, address, content in guarded.every_request():
            if address.endswith(but):
                continue
            with client.stream(methods or method, address, headers=headers, params=params, **content) as answer:
                assert answer.status_code < 500 or answer.status_code == 503, (method, address, answer.read())
                if moves_mills(method, address):
                    allowed = (*REFUSED, *((404, 405) if methods else ()))
                    assert answer.status_code in allowed, (method, address, answer.read())


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


@pytest.mark.thorough
def test_every_route_that_moves_a_mill_is_known_here(guarded: Guarded) -> None:
    found = {path for method, path in routes(guarded.floor) if moves_mills(method, path)}
    assert len(routes(guarded.floor)) > 30
    actions = {f"/v1/runs/{{id:uuid}}:{action}" for action in ("start", "hold", "resume", "abort", "recover")}
    control = "/v1/machines/{machine}/control"
    assert found == actions | {"/v1/machines/{machine}/runs", control} | {f"{control}/{order}" for order in ORDERS} | {
        "/v1/machines/{machine}/grants"
    }


def test_nobody(untouched: Guarded) -> None:
    send_all(untouched)


@pytest.mark.parametrize("scopes", [*[(scope,) for scope in OTHERS], OTHERS])
def test_tokens_of_other_scopes(untouched: Guarded, scopes: tuple[str, ...]) -> None:
    send_all(untouched, bearer(untouched.floor.token(*scopes)))


def test_revoked_and_expired_tokens(untouched: Guarded) -> None:
    book = untouched.floor.server.services.tokens
    token, secret = book.create("gone", ["machine:run", *OTHERS])
    book.revoke(token.id)
    send_all(untouched, bearer(secret))
    token, secret = book.create("old", ["machine:run", *OTHERS], expires_at=time.time() + 60)
    with begin_writing(untouched.floor.server.services.database) as connection:
        connection.execute(tokens.update().where(tokens.c.id == token.id).values(expires_at=time.time() - 1))
    send_all(untouched, bearer(secret), but=STOPS)  # one that has ended may still stop


@pytest.mark.thorough
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80", "X-Forwarded-Host": "localhost"},
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://[", "Sec-Fetch-Site": "none"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
    ids=lambda headers: " ".join(headers.values()),
)
def test_a_good_token_replayed_by_a_foreign_page(untouched: Guarded, headers: dict[str, str]) -> None:
    send_all(untouched, bearer(untouched.good) | headers)


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["{}", "Basic {}", "Bearer", "Bearer {}x", "Bearer x{}", "Token {}", "Bearer {},{}"])
def test_a_good_token_in_another_form(untouched: Guarded, form: str) -> None:
    send_all(untouched, {"Authorization": form.replace("{}", untouched.good)})


def test_two_authorizations(untouched: Guarded) -> None:
    good = ("Authorization", f"Bearer {untouched.good}")
    send_all(untouched, [good, ("Authorization", "Bearer cm_x")])
    send_all(untouched, [good, good])


@pytest.mark.parametrize("hosts", [(), ("evil.example", ""), ("", "evil.example"), ("", "")])
def test_no_host_or_two(untouched: Guarded, hosts: tuple[str, ...]) -> None:
    """As no client sends it; "" stands for the server's own name."""
    own = httpx.URL(untouched.floor.server.address)
    body = b'{"operator": "Mallory", "checks": ["tool", "zero", "stock", "clear"]}'
    lines = [f"POST /v1/runs/{untouched.run['id']}:start HTTP/1.1", f"Authorization: Bearer {untouched.good}"]
    lines += [f"Host: {host or own.netloc.decode()}" for host in hosts]
    lines += ["Content-Type: application/json", f"Content-Length: {len(body)}", "Connection: close", "", ""]
    with socket.create_connection((own.host, own.port or 80), timeout=PATIENCE_S) as wire:
        wire.sendall("\r\n".join(lines).encode() + body)
        assert wire.makefile("rb").readline().split()[1] == b"400"


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["token", "access_token", "authorization", "Authorization", "bearer"])
def test_a_good_token_where_none_belongs(untouched: Guarded, name: str) -> None:
    send_all(untouched, params={name: untouched.good})
    send_all(untouched, {"Cookie": f"{name}={untouched.good}", "X-Api-Key": untouched.good})


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "PATCH", "DELETE"])
def test_other_methods_and_words_for_them(untouched: Guarded, method: str) -> None:
    secret = untouched.floor.token(*OTHERS)
    override = dict.fromkeys(("X-HTTP-Method-Override", "X-HTTP-Method", "X-Method-Override"), "POST")
    send_all(untouched, bearer(secret) | override, {"_method": "POST"}, methods=method)


def test_the_agents_own_door_takes_no_token_of_the_server(untouched: Guarded) -> None:
    url = untouched.floor.card().url
    view = httpx.get(f"{url}/v1/runs", headers=bearer(untouched.good), timeout=PATIENCE_S)
    assert view.status_code == 401


def test_anonymous_callers_of_this_computer(guarded: Guarded) -> None:
    """As long as there never was a token they may work with jobs; mills are never theirs."""
    place, heard = guarded.mill.physical_mm, len(guarded.mill.heard)
    database = guarded.floor.server.services.database
    with begin_writing(database) as connection:
        rows = [dict(row) for row in connection.execute(tokens.select()).mappings()]
        connection.execute(tokens.delete())
    try:
        with httpx.Client(base_url=guarded.floor.server.address, timeout=PATIENCE_S) as client:
            assert client.get("/v1/jobs").status_code == 200
            assert client.get("/v1/jobs", headers={"X-Forwarded-For": "10.0.0.1"}).status_code == 401
            for method, address, content in _without_tokens(guarded):
                if address.endswith(STOPS):
                    continue  # tests/service/server/fleet/test_stops.py
                answer = client.request(method, address, **content)
                if moves_mills(method, address):
                    assert answer.status_code == 401, (method, address)
                assert answer.status_code < 500 or address == "/readyz", (method, address)
    finally:
        with begin_writing(database) as connection:
            connection.execute(tokens.insert(), rows)
    assert guarded.floor.get(f"/v1/runs/{guarded.run['id']}")["state"] == "parked"
    assert set(guarded.mill.heard[heard:]) <= set(b"?") and guarded.mill.physical_mm == place


def test_with_the_right_token_the_same_requests_move_it(guarded: Guarded) -> None:
    """So all the others were refused for who sent them, not for what they were. Runs last: the mill is used up."""
    with httpx.Client(
        base_url=guarded.floor.server.address, headers=bearer(guarded.good), timeout=PATIENCE_S
    ) as client:
        own = {"Origin": guarded.floor.server.address, "Sec-Fetch-Site": "same-origin"}
        start = f"/v1/runs/{guarded.run['id']}:start"
        assert give(client, start, json={"operator": "Ada", "checks": CHECKS}, headers=own).status_code == 202
    guarded.floor.until_state(guarded.run, "finished")
    assert guarded.floor.bench.cut == ends(60)


def _without_tokens(guarded: Guarded) -> list[tuple[str, str, dict[str, Any]]]:
    found = [
        (method, path) for method, path in routes(guarded.floor) if "/tokens/" not in path and "events" not in path
    ]
    keep = [(method, path) for method, path in found if method != "DELETE"]
    return [(method, guarded._address(path), guarded._content(method, path)) for method, path in keep]
