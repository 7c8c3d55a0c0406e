"""Presses of HOLD, each on its way to the mill by itself, and the moment when `!` is there."""

from __future__ import annotations

import contextlib
import http.client
import json
import queue
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import httpx
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, Event, Message, Ping, Request, TextMessage
from wsproto.utilities import LocalProtocolError

from tests.disturbances.floor import MILL, Floor
from tests.waiting import seen

PATIENCE_S = 10.0  # a press that has not arrived by then counts as so long
_SETTLE_S = 30.0
_PAUSE_S = (0.05, 0.15)

_BROKEN = ("RemoteDisconnected", "ConnectionResetError")

Press = Callable[[], str]
"""Sends one HOLD and waits for what is said to it: "" where it was taken."""


@dataclass
class Presses:
    """Seconds from each press to the wire; one that was refused or came too late counts as PATIENCE_S."""

    took_s: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)


class Presser:
    """Presses, sees what comes to the mill, and lets it run again.

    bystander : a connection to the agent that was there before anything was wrong
    """

    def __init__(self, floor: Floor, bystander: httpx.Client) -> None:
        self._floor = floor
        self._bystander = bystander
        self._chance = random.Random(7)

    def series(self, ways: dict[str, Press], lasts_s: float, *, share: Sequence[str], into: dict[str, Presses]) -> None:
        """Press in turn for so long; share: the order of the turns. AssertionError where the run does not go on."""
        until_s, number = time.monotonic() + lasts_s, 0
        while time.monotonic() < until_s:
            self._make_run()
            time.sleep(self._chance.uniform(*_PAUSE_S))
            way = share[number % len(share)]
            self._press(ways[way], into[way])
            number += 1

    def _press(self, press: Press, into: Presses) -> None:
        begun_s = time.monotonic()
        refusal = press()
        at_s = self._floor.mill.hold_after(begun_s, 0.5 if refusal else PATIENCE_S)
        if at_s is None:
            into.took_s.append(PATIENCE_S)
            into.missed.append(refusal or f"none in {PATIENCE_S:g} s")
            return
        into.took_s.append(min(at_s - begun_s, PATIENCE_S))
        self._until("held", "holding")

    def _make_run(self) -> None:
        """A hold that came too late to count holds the mill all the same."""
        while self._until("run", "held", "holding") != "run":
            self._resume()

    def _resume(self) -> None:
        """At the agent: by a grant where it hands them out."""
        self._until("held")
        granted = self._bystander.post("/v1/grants", json={})
        headers = {"Causticmill-Grant": granted.json()["grant"]} if granted.status_code == 201 else {}
        run = self._bystander.get("/v1/status").json()["run"]["id"]
        answer = self._bystander.post(f"/v1/runs/{run}:resume", headers=headers, json={})
        assert answer.status_code == 202, answer.text
        self._until("run")

    def _until(self, *states: str) -> str:
        status = seen(
            lambda: self._bystander.get("/v1/status").json(),
            lambda now: now["status"]["state"] in states or not _live(now),
            within_s=_SETTLE_S,
        )
        if not _live(status):
            raise AssertionError(f"the run has ended: {status['run']['state']}: {status['run']['words']}")
        return str(status["status"]["state"])


def _live(status: dict) -> bool:  # type: ignore[type-arg]
    return status["run"]["state"] in ("running", "holding", "held", "recovering")


def by_server(floor: Floor, token: str) -> Press:
    """One whose connection breaks is sent once more, as the page does it."""

    def press() -> str:
        said = _posted(floor.url, f"/v1/machines/{MILL}/control/hold", token)
        return _posted(floor.url, f"/v1/machines/{MILL}/control/hold", token) if said.startswith(_BROKEN) else said

    return press


class BySocket:
    """The way that is kept for stops (/v1/stops), open from before, as a page has it; one that broke is opened anew."""

    def __init__(self, floor: Floor, token: str) -> None:
        self._address = urlsplit(floor.url)
        self._token = token
        self._number = 0
        self._lock = threading.Lock()
        self._open()

    def _open(self) -> None:
        self._socket = socket.create_connection((str(self._address.hostname), self._address.port), timeout=PATIENCE_S)
        self._socket.settimeout(None)
        self._wire = WSConnection(ConnectionType.CLIENT)
        self._answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._closed = ""
        self._send(Request(host=self._address.netloc, target="/v1/stops"))
        threading.Thread(target=self._read, args=(self._socket,), daemon=True).start()
        if not self._answer({"open", "closed"}).get("open"):
            return
        self._send(Message(json.dumps({"token": self._token})))
        self._answer({"ready", "closed"})

    def __call__(self) -> str:
        """Press; where the socket breaks, once more over a new one: a stop that comes twice does no harm."""
        said = ""
        for _ in range(3):
            with contextlib.suppress(OSError, LocalProtocolError):
                if self._closed:
                    self._open()
                self._number += 1
                self._send(Message(json.dumps({"id": self._number, "machine": MILL, "what": "hold"})))
                answer = self._answer({"id", "closed"})
                if "closed" not in answer:
                    return "" if answer.get("taken") else str(answer.get("detail") or "no answer")[:100]
            said = f"the socket is closed: {self._closed}"
        return said

    def close(self) -> None:
        self._socket.close()

    def _answer(self, kinds: set[str]) -> dict[str, Any]:
        """The next one of these kinds; {} where none comes in time."""
        try:
            while not kinds & set(found := self._answers.get(timeout=PATIENCE_S)):
                continue
        except queue.Empty:
            return {}
        return found

    def _send(self, event: Event) -> None:
        with self._lock:
            self._socket.sendall(self._wire.send(event))

    def _read(self, wire: socket.socket) -> None:
        """As a browser does, also while nobody presses: the server asks whether we are there."""
        with contextlib.suppress(OSError):
            while not self._closed and (data := wire.recv(65536)):
                self._wire.receive_data(data)
                for event in self._wire.events():
                    self._heard(event)
        if wire is self._socket:
            self._closed = self._closed or "it ended"
            self._answers.put({"closed": True})

    def _heard(self, event: Event) -> None:
        if isinstance(event, Ping):
            self._send(event.response())
        elif isinstance(event, TextMessage):
            self._answers.put(json.loads(event.data))
        elif isinstance(event, AcceptConnection):
            self._answers.put({"open": True})
        else:
            self._closed = str(event)


def by_agent(floor: Floor) -> Press:
    """As it was before there was a server between: the same press at the agent itself."""
    url, token = floor.agent_url, floor.agent_token
    return lambda: _posted(url, "/v1/control/hold", token)


def _posted(url: str, path: str, token: str) -> str:
    """On a new connection, as a page whose others are taken."""
    parts = urlsplit(url)
    assert parts.hostname is not None
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=PATIENCE_S)
    try:
        connection.request("POST", path, headers={"Authorization": f"Bearer {token}", "Content-Length": "0"})
        answer = connection.getresponse()
        content = answer.read()
    except (OSError, http.client.HTTPException) as error:
        return f"{type(error).__name__}: {error}"
    finally:
        connection.close()
    return "" if answer.status == 202 else f"{answer.status} {_detail(content)}"


def _detail(content: bytes) -> str:
    with contextlib.suppress(ValueError, AttributeError):
        return str(json.loads(content).get("detail", ""))[:100]
    return ""


@contextlib.contextmanager
def in_background(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """A thread beside the presses, told to end with the block."""
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(60)
