"""What may be wrong with a computer while somebody presses HOLD."""

from __future__ import annotations

import contextlib
import http.client
import resource
import secrets
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import httpx
from sqlalchemy import update

from service.server.database.tables import tokens
from tests.benchmarks.stops.pressing import in_background
from tests.disturbances.floor import MILL, Floor

STREAMS = 50
SILENT = 1100
_AGAIN, _AGAIN_S = 50, 0.5  # so many of those that were cut come again, so often
READYZ = 20
GUESSERS = 8
_RESTART_EVERY_S = 4.0
LOOPS = 50
_LOCKED = """
import sqlite3, sys
book = sqlite3.connect(sys.argv[1], timeout=30, isolation_level=None)
book.execute("BEGIN EXCLUSIVE")
print("locked", flush=True)
sys.stdin.read()
"""
_BUSY = "print(flush=True)\nwhile True: pass"


def allow_files() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < 8192:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(8192, hard), hard))


@contextlib.contextmanager
def event_streams(floor: Floor) -> Iterator[None]:
    """Fifty readers of the mill's events, each read by us as a page would."""
    with contextlib.ExitStack() as stack:
        streams = []
        for _ in range(STREAMS):
            stream = stack.enter_context(_open(floor.url))
            request = f"GET /v1/machines/{MILL}/events HTTP/1.1\r\nHost: {_host(floor.url)}\r\n"
            stream.sendall(f"{request}Authorization: Bearer {floor.token}\r\n\r\n".encode())
            assert b"200 OK" in stream.recv(4096)
            streams.append(stream)

        def read(stop: threading.Event) -> None:
            while not stop.is_set():
                for stream in select.select(streams, [], [], 0.1)[0]:
                    stream.recv(65536)

        with in_background(read):
            yield


@contextlib.contextmanager
def silent_connections(floor: Floor) -> Iterator[None]:
    """At the server and at the agent, more than a process may usually have open; they say nothing and show no token.

    One that is cut comes again, as of whoever means harm.
    """
    with _crowd(floor.url, SILENT), _crowd(floor.agent_url, SILENT):
        yield


@contextlib.contextmanager
def slow_bodies(floor: Floor) -> Iterator[None]:
    """Heads that promise a body of which a byte comes now and then, at the server and at the agent; no token."""
    with contextlib.ExitStack() as stack:
        for url, path in ((floor.url, "/v1/jobs"), (floor.agent_url, "/v1/runs")):
            head = f"POST {path} HTTP/1.1\r\nHost: {_host(url)}\r\nContent-Length: 100000\r\n\r\nx"
            stack.enter_context(_crowd(url, SILENT, hello=head.encode(), drip=b"x"))
        yield


@contextlib.contextmanager
def silent_sockets(floor: Floor, count: int) -> Iterator[None]:
    """WebSockets for stops that never say who they are; a proxy has passed them on."""
    words = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "X-Forwarded-For: 192.0.2.1")
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
    head = "\r\n".join(("GET /v1/stops HTTP/1.1", f"Host: {_host(floor.url)}", *words, key, "", ""))
    with _crowd(floor.url, count, hello=head.encode()):
        yield


@contextlib.contextmanager
def bogus_tokens(floor: Floor) -> Iterator[None]:
    """Callers who try tokens as fast as they are answered, for jobs and for stops."""
    parts = urlsplit(floor.url)

    def attempt(stop: threading.Event) -> None:
        number = 0
        connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=20)
        while not stop.is_set():
            number += 1
            secret = f"cm_{secrets.token_urlsafe(32)}"
            headers = {"Authorization": f"Bearer {secret}", "X-Forwarded-For": "192.0.2.1"}
            method, path = ("GET", "/v1/jobs") if number % 2 else ("POST", f"/v1/machines/{MILL}/control/hold")
            with contextlib.suppress(OSError, http.client.HTTPException):
                connection.request(method, path, headers=headers)
                connection.getresponse().read()
                continue
            connection.close()
        connection.close()

    with contextlib.ExitStack() as stack:
        for _ in range(GUESSERS):
            stack.enter_context(in_background(attempt))
        yield


@contextlib.contextmanager
def api_restarts(floor: Floor) -> Iterator[None]:
    """The API is killed again and again, each time some seconds after it has come back."""

    def kill(stop: threading.Event) -> None:
        while not stop.wait(_RESTART_EVERY_S):
            if floor.serving.child("service.server.api.main"):
                floor.kill_api()

    with in_background(kill):
        yield
    with contextlib.suppress(httpx.HTTPError):
        httpx.get(f"{floor.url}/livez", timeout=30, trust_env=False)


@contextlib.contextmanager
def _crowd(url: str, count: int, *, hello: bytes = b"", drip: bytes = b"") -> Iterator[None]:
    """Connections of strangers: each says hello, then drips; one that is cut comes again."""
    address = (str(urlsplit(url).hostname), int(urlsplit(url).port or 0))
    held: dict[int, socket.socket] = {}
    poll = select.poll()

    def dial(number: int) -> None:
        for _ in range(number):
            with contextlib.suppress(OSError):
                one = socket.create_connection(address, timeout=5)
                one.setblocking(False)
                one.send(hello)
                held[one.fileno()] = one
                poll.register(one, select.POLLIN | select.POLLHUP)

    def keep(stop: threading.Event) -> None:
        while not stop.wait(_AGAIN_S):
            for number, _ in poll.poll(0):
                data = b""
                with contextlib.suppress(OSError):
                    data = held[number].recv(4096)
                if not data:
                    poll.unregister(number)
                    held.pop(number).close()
            for one in held.values():
                with contextlib.suppress(OSError):
                    one.send(drip)
            dial(min(_AGAIN, count - len(held)))

    dial(count)
    with in_background(keep):
        time.sleep(1.0)
        yield
    for one in held.values():
        one.close()


@contextlib.contextmanager
def locked_database(floor: Floor) -> Iterator[None]:
    """A second process has the database for itself, and twenty requests of /readyz wait for it all the time."""
    command = [sys.executable, "-c", _LOCKED, str(floor.settings.sqlite)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdin is not None
        assert process.stdout.readline() == "locked\n"

        def ask(stop: threading.Event) -> None:
            while not stop.is_set():
                parts = urlsplit(floor.url)
                connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=60)
                with contextlib.suppress(OSError, http.client.HTTPException):
                    connection.request("GET", "/readyz")
                    connection.getresponse().read()
                connection.close()

        with contextlib.ExitStack() as stack:
            for _ in range(READYZ):
                stack.enter_context(in_background(ask))
            time.sleep(0.5)
            yield
            process.stdin.close()
            process.wait()


@contextlib.contextmanager
def busy_computer(_: Floor | None = None) -> Iterator[None]:
    """Fifty loops at the usual priority."""
    loops = [subprocess.Popen([sys.executable, "-S", "-c", _BUSY], stdout=subprocess.PIPE) for _ in range(LOOPS)]
    try:
        for loop in loops:
            assert loop.stdout is not None
            loop.stdout.readline()
        yield
    finally:
        for loop in loops:
            loop.kill()
        for loop in loops:
            loop.wait()
            assert loop.stdout is not None
            loop.stdout.close()


def expire(floor: Floor, name: str) -> None:
    """The token of this name ended a minute ago."""
    with floor.database() as database, database.begin() as connection:
        connection.execute(update(tokens).where(tokens.c.name == name).values(expires_at=time.time() - 60))


def _open(url: str) -> socket.socket:
    parts = urlsplit(url)
    return socket.create_connection((str(parts.hostname), parts.port), timeout=20)


def _host(url: str) -> str:
    return urlsplit(url).netloc
