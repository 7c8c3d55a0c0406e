"""The standby: it stops mills while there is no API, and keeps everything else for it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
from collections.abc import Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.http import serving
from service.http.hosts import bind_address
from service.processes.lifeline import GONE, SERVING, make_line, say
from service.server.fleet.agent_client import AT_THE_SERVER, AgentLinks
from service.server.fleet.machine_stops import MachineStops
from service.server.standby.line import ApiWatch
from service.server.standby.main import Standby, StandbyApp
from service.server.stop_socket import identify_stopper
from service.server.stoppers import FILE, Stopper, StopperFile, hash_secret, read_stoppers, write_stoppers
from service.settings import ServerSettings
from tests.service.server.fleet.rogue import Rogue, as_json, rogue_agent
from tests.service.server.fleet.shop import own_folders
from tests.waiting import PATIENCE_S, seen, until

ELSEWHERE = {"X-Forwarded-For": "192.0.2.1"}
HOLD = "/v1/machines/far/control/hold"


@dataclass
class Alone:
    """A standby in a thread, without an API; `api` is that one's end of the line."""

    url: str
    data: Path
    agent: Rogue
    api: socket.socket

    def post(self, path: str, token: str = "", **headers: str) -> httpx.Response:
        own = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.post(self.url + path, headers=own | headers, timeout=PATIENCE_S, trust_env=False)


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Alone]:
    with run_alone(tmp_path, monkeypatch) as alone:
        yield alone


@contextlib.contextmanager
def run_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Alone]:
    own_folders(monkeypatch, tmp_path)
    data, listing, key = tmp_path / "data", tmp_path / "agents.toml", tmp_path / "token"
    data.mkdir()
    key.write_text("x" * 40 + "\n")
    key.chmod(0o600)
    with rogue_agent("far") as agent, contextlib.closing(bind_address("127.0.0.1", 0)) as listener:
        agent.answers = lambda _method, _path: as_json({"status": {"state": "hold"}, "id": "1", "state": "held"}, 202)
        listing.write_text(f'[[agents]]\nmachine = "far"\nurl = "{agent.url}"\ntoken_file = "token"\n')
        settings = ServerSettings(data=data, agents_file=listing)
        line, api = make_line()
        loop, over, listens = asyncio.new_event_loop(), asyncio.Event(), threading.Event()

        async def serve() -> None:
            links = AgentLinks(settings)
            app = StandbyApp(settings, MachineStops(links), StopperFile(data / FILE))
            standby = Standby(app, listener, line)
            listens.set()
            await over.wait()
            standby.close()
            await links.close()

        thread = threading.Thread(target=lambda: loop.run_until_complete(serve()), daemon=True)
        thread.start()
        assert listens.wait(PATIENCE_S)
        try:
            yield Alone(f"http://127.0.0.1:{listener.getsockname()[1]}", data, agent, api)
        finally:
            loop.call_soon_threadsafe(over.set)
            thread.join(PATIENCE_S)
            loop.close()
            for end in (line, api):
                end.close()


def test_it_stops_a_mill_and_a_run_without_api_and_database(alone: Alone) -> None:
    assert alone.post(HOLD).status_code == 202
    assert ("POST", "/v1/control/hold") in alone.agent.asked
    answer = alone.post("/v1/runs/abc:abort")
    assert (answer.status_code, answer.json()["id"]) == (202, "abc")
    assert ("POST", "/v1/runs/abc:abort") in alone.agent.asked
    assert alone.post("/v1/machines/none/control/hold").status_code == 404


@pytest.mark.parametrize(
    ("behind_proxy", "peer", "headers", "secret", "name"),
    [
        (False, "127.0.0.1", [], "", AT_THE_SERVER),
        (False, "127.0.0.1", [], "cm_unknown", AT_THE_SERVER),
        (False, "127.0.0.1", [(b"x-forwarded-for", b"192.0.2.1")], "", None),
        (True, "127.0.0.1", [], "", None),  # a proxy on this computer may add no header
        (False, "192.0.2.1", [], "", None),
        (False, "192.0.2.1", [], "cm_ada", "Ada"),
        (True, "127.0.0.1", [], "cm_ada", "Ada"),
    ],
)
def test_who_may_stop_a_mill(
    behind_proxy: bool, peer: str, headers: list[tuple[bytes, bytes]], secret: str, name: str | None
) -> None:
    scope = {"type": "http", "client": (peer, 1), "headers": headers, "http_version": "1.1"}
    found = identify_stopper(scope, secret, {"cm_ada": Stopper("1", "Ada")}.get, behind_proxy=behind_proxy)
    assert (found and found.name) == name


def test_who_may_is_known_from_the_file(alone: Alone) -> None:
    """From elsewhere a token that the API has written down, and no other; no page of another site."""
    write_stoppers(alone.data / FILE, {hash_secret("cm_mine"): Stopper("1", "Ada")})
    assert ((alone.data / FILE).stat().st_mode & 0o777) == 0o600
    assert "cm_mine" not in (alone.data / FILE).read_text()
    assert alone.post(HOLD, "cm_mine", **ELSEWHERE).status_code == 202
    assert alone.post(HOLD, "cm_other", **ELSEWHERE).status_code == 401
    assert alone.post(HOLD, **ELSEWHERE).status_code == 401
    assert alone.post(HOLD, Origin="https://evil.example").status_code == 403
    assert alone.post(HOLD, Host="[::1].evil.com").status_code == 403
    write_stoppers(alone.data / FILE, {})
    assert alone.post(HOLD, "cm_mine", **ELSEWHERE).status_code == 401


@pytest.mark.parametrize("content", [b"", b"[]", b'{"a": 1}', b'{"a": {"x": 1}}', b"\xff"])
def test_a_file_that_says_nothing_lets_nobody_stop(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    assert read_stoppers(tmp_path / FILE) == {}


def test_what_is_no_stop_waits_for_the_api_and_is_handed_over_whole(alone: Alone) -> None:
    with socket.create_connection(("127.0.0.1", int(alone.url.rpartition(":")[2])), timeout=PATIENCE_S) as caller:
        request = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\nhalf a body"
        caller.sendall(request)
        assert alone.post(HOLD).status_code == 202  # meanwhile
        say(alone.api, SERVING)
        alone.api.setblocking(True)
        received, (descriptor,), _, _ = socket.recv_fds(alone.api, 100_000, 1)
        assert received == request
        with socket.socket(fileno=descriptor) as connection:
            connection.setblocking(True)
            caller.sendall(b", and its end")
            assert connection.recv(100) == b", and its end"
            connection.sendall(b"HTTP/1.1 202 Accepted\r\n\r\n")
        assert caller.recv(100).startswith(b"HTTP/1.1 202")


def test_a_connection_that_was_closed_meanwhile_is_not_handed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next caller has the number of its descriptor by then, and would get an answer that was meant for another."""
    held, hand_over = [], ApiWatch.hand_over

    def note(self: ApiWatch, connection: int, received: bytes, within_s: float) -> Coroutine[Any, Any, bool]:
        held.append(received)
        return hand_over(self, connection, received, within_s)

    monkeypatch.setattr(ApiWatch, "hand_over", note)
    monkeypatch.setattr(serving, "_STRANGERS", 1)
    half = "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{}"
    with run_alone(tmp_path, monkeypatch) as alone, contextlib.ExitStack() as stack:
        callers = []
        for name in ("first", "second", "third"):
            address = ("127.0.0.1", int(alone.url.rpartition(":")[2]))
            caller = stack.enter_context(socket.create_connection(address, timeout=PATIENCE_S))
            caller.sendall(half.format(name).encode())
            callers.append(caller)
            until(lambda: len(held) == len(callers), what="the request at the standby")
            for before in callers[:-1]:
                with contextlib.suppress(ConnectionError):
                    assert before.recv(100) == b"", "it had to make room"
        say(alone.api, SERVING)
        alone.api.settimeout(PATIENCE_S)
        received, descriptors, _, _ = socket.recv_fds(alone.api, 100_000, 1)
        for descriptor in descriptors:
            os.close(descriptor)
        assert received.endswith(b"third")
        assert alone.post(HOLD).status_code == 202  # by now anything else would have been handed over
        alone.api.setblocking(False)
        with pytest.raises(BlockingIOError):
            alone.api.recv(100_000)


def test_it_accepts_nobody_while_the_api_serves_and_takes_over_where_that_falls_silent(alone: Alone) -> None:
    port = int(alone.url.rpartition(":")[2])
    say(alone.api, SERVING)

    def answered(within_s: float) -> bool:
        with contextlib.suppress(OSError, httpx.HTTPError):
            return httpx.post(f"{alone.url}{HOLD}", timeout=within_s, trust_env=False).status_code == 202
        return False

    seen(lambda: answered(0.2), lambda yes: not yes)  # it waits in the queue of the one who serves
    until(lambda: answered(PATIENCE_S), what="the standby, after a silence")
    say(alone.api, SERVING)
    say(alone.api, GONE)
    assert answered(PATIENCE_S) and port
