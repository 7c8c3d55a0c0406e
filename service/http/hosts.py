"""Decides which addresses are this computer, and which Host headers may be served.

A page in a browser on the same machine could be served from a name that is re-pointed to 127.0.0.1 (DNS rebinding) and
talk to us; a name cannot be re-pointed when only addresses and known names are accepted.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Iterable

from phrases.phrase import Phrase
from service.errors import InputError


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_unread(host: str, where: str, *, vouched: bool, allowed: str) -> None:
    """Raise InputError if others could read traffic with an address on its way, and nobody vouches that they cannot.

    vouched : a person states that there is TLS, or nobody else on the network; allowed: how to arrange that
    """
    if not (vouched or is_loopback(host)):
        raise InputError(
            Phrase(
                "{where}, and tokens and orders would cross the network unencrypted; allowed: {allowed}",
                where=where,
                allowed=allowed,
            )
        )


def own_names(more: Iterable[str] = ()) -> frozenset[str]:
    """Return the host names of this computer in lower case. more: further ones, of the settings"""
    return frozenset({"localhost", socket.gethostname().lower(), *(name.lower() for name in more)})


_AUTHORITY = re.compile(r"(?:\[(?P<v6>[^\[\]@/]+)\]|(?P<name>[^\[\]@/:]+))(?::[0-9]{0,5})?")


def is_own_host(header: str, names: frozenset[str]) -> bool:
    """Return whether a Host header, lower case, is one of the names or an address, with or without a port."""
    parts = _AUTHORITY.fullmatch(header)
    if parts is None:
        return False
    if parts["name"] in names:
        return True
    try:
        return ipaddress.ip_address(parts["name"] or parts["v6"]).version == (4 if parts["name"] else 6)
    except ValueError:
        return False
