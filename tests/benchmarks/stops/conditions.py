"""What may be wrong with a computer while somebody presses HOLD."""

from __future__ import annotations

import contextlib
import http.client
import resource
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

from sqlalchemy import update

from service.server.database.tables import tokens
from tests.benchmarks.stops.pressing import in_background
from tests.disturbances.floor import MILL, Floor

STREAMS = 50
SILENT = 1100
_AGAIN, _AGAIN_S = 50, 0.5  # so many of those that were cut come again, so often
READYZ = 20
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
    with contextlib.ExitStack() as stack:
        for url in (floor.url, floor.agent_url):
            stack.enter_context(_kept_silent(url))
        time.sleep(1.0)
        yield


@contextlib.contextmanager
def _kept_silent(url: str) -> Iterator[None]:
    address = (urlsplit(url).hostname, urlsplit(url).port)
    held: dict[int, socket.socket] = {}
    poll = select.poll()

    def dial(count: int) -> None:
        for _ in range(count):
            one = socket.socket()
            one.setblocking(False)
            one.connect_ex(address)
            held[one.fileno()] = one
            poll.register(one, select.POLLIN | select.POLLHUP)

    def keep(stop: threading.Event) -> None:
        while not stop.is_set():
            for number, _ in poll.poll(0):
                poll.unregister(number)
                held.pop(number).close()
            dial(min(_AGAIN, SILENT - len(held)))
            stop.wait(_AGAIN_S)

    dial(SILENT)
    with in_background(keep):
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
