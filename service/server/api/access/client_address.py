"""Where a request comes from: this very computer, or an address, which a proxy in front of us may have to tell."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping

from starlette.types import Scope

from service.http.hosts import is_loopback

_FORWARDED = frozenset({b"forwarded", b"via", b"x-real-ip"})
_NETWORK_BITS = 64  # of IPv6: what one household or one attacker has to itself
_HERE, _LONGEST = "this computer", 100


def is_here(scope: Scope, headers: Mapping[bytes, bytes]) -> bool:
    """Return whether the caller is on this computer, and no proxy has passed its request on; some only speak
    HTTP/1.0.
    """
    peer = scope.get("client")
    forwarded = any(name in _FORWARDED or name.startswith(b"x-forwarded-") for name in headers)
    direct = not forwarded and scope.get("http_version") != "1.0"
    return peer is not None and is_loopback(peer[0]) and direct


def address_of(scope: Scope, *, behind_proxy: bool) -> str:
    """Return a word for the place that a request comes from, for counting; of IPv6 the network.

    Only a proxy that the settings know of is believed, and of what it passes on only the last entry, its own. One that
    adds none lets callers make addresses up: what must hold then, too, must not be counted by address alone.
    """
    headers = dict(scope["headers"])
    if is_here(scope, headers) and not behind_proxy:
        return _HERE
    peer = scope.get("client")
    told = headers.get(b"x-forwarded-for", b"").decode("latin-1").rpartition(",")[2].strip() if behind_proxy else ""
    return _network(told) or f"by way of {peer[0] if peer else 'nobody'}"[:_LONGEST]


def is_this_computer(address: str) -> bool:
    """Return a word of `address_of` that stands for callers on this computer."""
    return address == _HERE


def _network(text: str) -> str:
    """Return an address as text, or the network of one; "" where it is none."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return ""
    if address.version == 4:
        return str(address)
    return str(ipaddress.ip_network((int(address), _NETWORK_BITS), strict=False))
