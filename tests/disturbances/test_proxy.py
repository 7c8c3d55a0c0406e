"""The proxy does to bytes what it says, and nothing else: the tests that use it rest on that."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from tests.disturbances.proxy import HoldingProxy

_QUIET_S = 0.2


@pytest.fixture
def echo() -> Iterator[int]:
    """The port of a server that sends back what it gets."""
    listener = socket.create_server(("127.0.0.1", 0))

    def answer(connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            while data := connection.recv(4096):
                connection.sendall(data)

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=answer, args=(listener.accept()[0],), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    yield listener.getsockname()[1]
    listener.close()


@pytest.fixture
def proxy(echo: int) -> Iterator[HoldingProxy]:
    with HoldingProxy("127.0.0.1", echo) as found:
        yield found


def dialled(proxy: HoldingProxy) -> socket.socket:
    return socket.create_connection(("127.0.0.1", proxy.port), timeout=20)


def nothing_comes(client: socket.socket) -> bool:
    client.settimeout(_QUIET_S)
    try:
        client.recv(1, socket.MSG_PEEK)
    except TimeoutError:
        return True
    finally:
        client.settimeout(20)
    return False


@pytest.mark.parametrize("way", ["there", "back"])
def test_what_is_held_back_comes_whole_and_in_order_afterwards(proxy: HoldingProxy, way: str) -> None:
    with dialled(proxy) as client:
        client.sendall(b"a")
        assert client.recv(10) == b"a"
        with proxy.hold(way):  # type: ignore[arg-type]
            client.sendall(b"first,")
            client.sendall(b"second")
            proxy.until_carried(way, len("afirst,second"))  # type: ignore[arg-type]
            assert nothing_comes(client)
        got = b""
        while len(got) < len("first,second"):
            got += client.recv(100)
        assert got == b"first,second"


def test_a_delay_is_kept_and_can_be_taken_off(proxy: HoldingProxy) -> None:
    with dialled(proxy) as client:
        proxy.delay("back", 0.5)
        begun_s = time.monotonic()
        client.sendall(b"late")
        assert client.recv(10) == b"late" and time.monotonic() - begun_s >= 0.5
        proxy.delay("back", 3600)
        client.sendall(b"now")
        assert nothing_comes(client)
        proxy.delay("back", 0)
        assert client.recv(10) == b"now"


def test_a_dropped_answer_was_heard_there_and_never_comes(proxy: HoldingProxy) -> None:
    with dialled(proxy) as client:
        with proxy.drop("back"):
            client.sendall(b"order")
            proxy.until_carried("back", len("order"))
        with contextlib.suppress(ConnectionError):
            assert client.recv(10) == b""
    with dialled(proxy) as client:
        client.sendall(b"again")
        assert client.recv(10) == b"again"


def test_while_away_connections_end_and_none_is_made(proxy: HoldingProxy) -> None:
    with dialled(proxy) as before:
        with proxy.away():
            with contextlib.suppress(ConnectionError):
                assert before.recv(1) == b""
            with contextlib.suppress(ConnectionError), dialled(proxy) as during:
                assert during.recv(1) == b""
        with dialled(proxy) as after:
            after.sendall(b"x")
            assert after.recv(1) == b"x"


def test_the_end_of_a_stream_is_passed_on(proxy: HoldingProxy) -> None:
    with dialled(proxy) as client:
        client.sendall(b"bye")
        client.shutdown(socket.SHUT_WR)
        got = b""
        while piece := client.recv(10):
            got += piece
        assert got == b"bye"
