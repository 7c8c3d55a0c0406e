"""Which Host headers are this computer's, and the binding of an address."""

from __future__ import annotations

import contextlib

import pytest

from service.errors import InputError
from service.http.hosts import bind_address, is_own_host

NAMES = frozenset({"localhost", "mill.local"})
OWN = (
    "localhost", "localhost:8000", "mill.local", "mill.local:80", "127.0.0.1", "127.0.0.1:8000", "192.168.1.7:8000",
    "[::1]", "[::1]:8000", "[fe80::1]",
)  # fmt: skip
FOREIGN = (
    "", ":8000", "evil.com", "localhost.evil.com", "[::1].evil.com", "[::1].evil.com:8000", "[::1]x", "[localhost]",
    "[::1]:80.evil.com", "[evil.com]", "[127.0.0.1]", "::1", "127.0.0.1.evil.com", "127.0.0.1:80.evil.com", "127.1",
    "127.0.0.1:x", "localhost:8000:1", "x@localhost", "localhost:1@evil.com", "[::1", "::1]", "[[::1]]",
)  # fmt: skip


@pytest.mark.parametrize("header", OWN)
def test_addresses_and_names_of_this_computer_are_its_own(header: str) -> None:
    assert is_own_host(header, NAMES)


@pytest.mark.parametrize("header", FOREIGN)
def test_nothing_else_is(header: str) -> None:
    """What a name server of somebody else's could point here."""
    assert not is_own_host(header, NAMES)


def test_a_taken_address_is_refused_with_the_option_that_set_it() -> None:
    with contextlib.closing(bind_address("127.0.0.1", 0, backlog=1)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match=f"--bind-port {port} on 127.0.0.1 is in use"):
            bind_address("127.0.0.1", port, option="--bind-port", backlog=1)
