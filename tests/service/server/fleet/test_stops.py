"""A stop needs nothing that can be busy, full, expired or away."""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import httpx
import pytest
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, CloseConnection, RejectConnection, Request, TextMessage

from machines.clock import suspend_aware_clock_s
from machines.errors import MachineError
from machines.journal.disk import RealFile
from machines.mill.orders import Caller, Stop
from service.milling.agent.agent import MillAccess
from service.server.database.connection import begin_writing
from service.server.database.tables import tokens
from service.server.fleet import agent_client
from tests.service.server.api.server import api_server, problem
from tests.service.server.fleet.rogue import as_json, rogue_agent
from tests.service.server.fleet.shop import MACHINE, Shop, own_folders
from tests.service.server.fleet.test_control import Person
from tests.waiting import PATIENCE_S, seen, until

HERE = f"/v1/machines/{MACHINE}/control"
ELSEWHERE = {"X-Forwarded-For": "192.0.2.1"}  # a proxy has passed it on: not from this computer


@contextlib.contextmanager
def locked(database: Path) -> Iterator[None]:
    """Another program holds the database for itself."""
    with contextlib.closing(sqlite3.connect(database, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        yield
        other.execute("ROLLBACK")


def jog_far(floor: Shop) -> Person:
    ada = Person(floor, "Ada")
    ada.take()
    assert ada.jog(250, feed=300).status_code == 202
    until(lambda: not floor.bench.stands)
    return ada


@pytest.mark.parametrize("what", ["hold", "jog-cancel", "abort"])
def test_it_arrives_while_the_database_is_locked_and_health_is_asked_for(floor: Shop, what: str) -> None:
    jog_far(floor)
    with locked(floor.settings.sqlite), contextlib.ExitStack() as stack:
        for _ in range(20):
            stream = stack.enter_context(socket.create_connection(("127.0.0.1", floor.server.port)))
            stream.sendall(b"GET /readyz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        began_s = time.monotonic()
        assert httpx.post(f"{floor.server.address}{HERE}/{what}", timeout=PATIENCE_S).status_code == 202
        answered_s = time.monotonic() - began_s
        until(lambda: floor.bench.stands)
    assert answered_s < 15.0  # the lock ends after the test only; sqlite waits for 30 s


def test_a_run_is_held_while_the_database_is_locked(floor: Shop) -> None:
    """By a server that has just been started, too: the agent knows the run by our id."""
    run = floor.park(floor.job((600,)))
    floor.start(run)
    floor.until_cut(3)
    path = f"/v1/runs/{run['id']}:hold"
    with locked(floor.settings.sqlite):
        assert httpx.post(f"{floor.server.address}{path}", timeout=PATIENCE_S).status_code == 202
        until(lambda: floor.bench.stands)
    floor.until_state(run, "held")
    floor.server.services.fleet._core.known_runs.clear()
    floor.post(f"/v1/runs/{run['id']}:resume", 202)
    floor.until_state(run, "running")
    with locked(floor.settings.sqlite):
        assert httpx.post(f"{floor.server.address}{path}", timeout=PATIENCE_S).status_code == 202
        until(lambda: floor.bench.stands)


@pytest.mark.parametrize("at", ["machine", "run"])
def test_a_hold_that_has_left_is_a_success_while_the_disk_of_the_mill_hangs(
    floor: Shop, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    """The agent's own thread waits for its journal meanwhile, and does its part of the hold when it can."""
    run = floor.park(floor.job((600,)))
    floor.start(run)
    floor.until_cut(3)
    write, hangs, free = RealFile.write, threading.Event(), threading.Event()

    def hang(file: RealFile, data: bytes) -> None:
        hangs.set()
        free.wait(PATIENCE_S)
        write(file, data)

    path = f"{HERE}/hold" if at == "machine" else f"/v1/runs/{run['id']}:hold"
    monkeypatch.setattr(RealFile, "write", hang)
    try:
        assert hangs.wait(PATIENCE_S)
        answer = httpx.post(f"{floor.server.address}{path}", timeout=PATIENCE_S)
        assert answer.status_code == 202, answer.text
        until(lambda: floor.bench.stands)
    finally:
        free.set()
    floor.until_state(run, "held")


def test_an_agent_answers_a_stop_sooner_than_its_server_gives_up() -> None:
    """Also where the link has no byte for it and the mill's thread does not answer: that is said, by the agent."""

    class Busy:
        def halt(self, *_: object) -> tuple[bool, Future[None]]:
            return written, Future()

    async def halt() -> None:
        async with asyncio.timeout(agent_client._STOP_TRY_S):
            await MillAccess(Busy()).halt(Stop.HOLD, Caller())  # type: ignore[arg-type]

    written = True
    asyncio.run(halt())
    written = False
    with pytest.raises(MachineError, match="no answer"):
        asyncio.run(halt())


def test_who_may(floor: Shop) -> None:
    """Whoever is here; from elsewhere a token that may run mills, even one that has ended, not one that was revoked."""
    ada = Person(floor, "Ada")
    hold = f"{floor.server.address}{HERE}/hold"
    assert httpx.post(hold, timeout=PATIENCE_S).status_code == 202
    problem(httpx.post(hold, headers=ELSEWHERE, timeout=PATIENCE_S), 401)
    foreign = {"Origin": "https://example.org"}
    problem(httpx.post(hold, headers=foreign, timeout=PATIENCE_S), 403)
    with floor.client("jobs:read", "jobs:write", "admin") as weak:
        problem(weak.post(f"{HERE}/hold", headers=ELSEWHERE), 403)
    authorization = dict(ada.http.headers) | ELSEWHERE
    assert httpx.post(hold, headers=authorization, timeout=PATIENCE_S).status_code == 202
    with begin_writing(floor.server.services.database) as connection:
        connection.execute(tokens.update().values(expires_at=time.time() - 1))
    problem(ada.http.get(f"/v1/machines/{MACHINE}", headers=ELSEWHERE), 401)
    assert httpx.post(hold, headers=authorization, timeout=PATIENCE_S).status_code == 202
    with begin_writing(floor.server.services.database) as connection:
        connection.execute(tokens.update().values(revoked_at=time.time()))
    press = lambda: httpx.post(hold, headers=authorization, timeout=PATIENCE_S).status_code  # noqa: E731
    seen(press, lambda code: code == 401, every_s=0.25)


class StopSocket:
    """A page's own way for stops."""

    def __init__(
        self, port: int, *, origin: str = "", token: str | None = "", more: dict[str, str] | None = None
    ) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self._ws = WSConnection(ConnectionType.CLIENT)
        headers = [(b"Origin", (origin or f"http://127.0.0.1:{port}").encode())]
        headers += [(name.encode(), value.encode()) for name, value in (more or {}).items()]
        self._send(Request(host=f"127.0.0.1:{port}", target="/v1/stops", extra_headers=headers))
        self._events: list[Any] = []
        self.accepted = isinstance(self._next(), AcceptConnection)
        if self.accepted and token is not None:
            self.say({"token": token})

    def say(self, values: object) -> None:
        self._send(TextMessage(json.dumps(values)))

    def say_bytes(self, data: bytes) -> None:
        self._send(BytesMessage(data))

    def hear(self) -> Any:
        """What comes next but beats; the code of a close."""
        while True:
            event = self._next()
            if isinstance(event, CloseConnection):
                return event.code
            found = json.loads(event.data)
            if "beat" not in found:
                return found

    def close(self) -> None:
        self._socket.close()

    def _send(self, event: Any) -> None:
        self._socket.sendall(self._ws.send(event))

    def _next(self) -> Any:
        wanted = (AcceptConnection, RejectConnection, TextMessage, CloseConnection)
        while not self._events:
            self._ws.receive_data(self._socket.recv(65536) or None)
            self._events += [event for event in self._ws.events() if isinstance(event, wanted)]
        return self._events.pop(0)


@pytest.mark.parametrize("token", ["", None])
def test_a_socket_that_sends_bytes_is_closed_and_no_fault_of_ours(
    floor: Shop, caplog: pytest.LogCaptureFixture, token: str | None
) -> None:
    with contextlib.closing(StopSocket(floor.server.port, token=token)) as page:
        if token is not None:
            assert page.hear() == {"ready": True}
        page.say_bytes(b"\0")
        assert page.hear() == 1000
    assert not [record for record in caplog.records if record.exc_info]


def test_a_socket_of_its_own_stops_the_mill(floor: Shop) -> None:
    jog_far(floor)
    with contextlib.closing(StopSocket(floor.server.port)) as page:
        assert page.hear() == {"ready": True}
        pressed_s = suspend_aware_clock_s()
        page.say({"id": 7, "machine": MACHINE, "what": "hold"})
        answer = page.hear()
        assert (answer["id"], answer["taken"]) == (7, True), answer
        until(lambda: floor.bench.stands)
        stopped_s = floor.server.services.fleet._core.stopped_s[MACHINE]
        assert stopped_s >= pressed_s, "an order that came before this stop would still be sent"
        page.say({"id": 8, "machine": "none", "what": "hold"})
        assert page.hear()["taken"] is False
        page.say({"id": 9, "machine": MACHINE, "what": "home"})
        assert "allowed" in page.hear()["detail"]
        page.say("not an object")
        assert page.hear()["taken"] is False


def test_the_socket_is_for_our_own_pages_and_known_tokens(floor: Shop) -> None:
    port = floor.server.port
    with contextlib.closing(StopSocket(port, origin="https://example.org")) as foreign:
        assert not foreign.accepted
    with contextlib.closing(StopSocket(port, more=ELSEWHERE)) as stranger:
        assert stranger.hear() == 4401
    token = floor.token("machine:run")
    until(lambda: floor.server.services.stop_access.find(token) is not None)
    with contextlib.closing(StopSocket(port, token=token, more=ELSEWHERE)) as known:
        assert known.hear() == {"ready": True}


def test_a_page_that_goes_is_no_error(floor: Shop, caplog: pytest.LogCaptureFixture) -> None:
    """Whether it says so or its connection is cut: nobody has to read a traceback of it."""
    open_ones = floor.server.services.stop_sockets.open
    for says_so in (True, False):
        page = StopSocket(floor.server.port)
        assert page.hear() == {"ready": True} and open_ones
        if says_so:
            page._send(CloseConnection(code=1001))
        page.close()
        until(lambda: not open_ones)
    httpx.get(f"{floor.server.address}/livez").raise_for_status()
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.thorough
def test_it_arrives_through_a_crowd_of_silent_connections(floor: Shop) -> None:
    """At the agent and at the server, more than either keeps; those who have a token keep their place."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (8192, max(8192, resource.getrlimit(resource.RLIMIT_NOFILE)[1])))
    jog_far(floor)
    agent_port = int(floor.card().url.rpartition(":")[2])
    with contextlib.ExitStack() as stack:
        for port in (agent_port, floor.server.port):
            for _ in range(1100):
                with contextlib.suppress(OSError):
                    stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S))
        assert httpx.post(f"{floor.server.address}{HERE}/hold", timeout=PATIENCE_S).status_code == 202
        until(lambda: floor.bench.stands)


def test_it_goes_to_the_agent_that_the_list_names_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_folders(monkeypatch, tmp_path)
    listing, token = tmp_path / "agents.toml", tmp_path / "token"
    token.write_text("x" * 40 + "\n")
    token.chmod(0o600)
    with rogue_agent("far") as old, rogue_agent("far") as new:
        for rogue in (old, new):
            rogue.answers = lambda _method, _path: as_json({"status": {"state": "idle"}, "events": []}, 202)

        def name(rogue: Any) -> None:
            listing.write_text(f'[[agents]]\nmachine = "far"\nurl = "{rogue.url}"\ntoken_file = "token"\n')

        name(old)
        with api_server(tmp_path / "data", agents_file=listing) as server:
            stop = f"{server.address}/v1/machines/far/control/hold"
            assert httpx.post(stop, timeout=PATIENCE_S).status_code == 202
            name(new)
            assert httpx.post(stop, timeout=PATIENCE_S).status_code == 202
        assert ("POST", "/v1/control/hold") in new.asked
