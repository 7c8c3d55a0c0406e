"""The addresses of a server: those of this computer, the accepted Host headers, and the listening socket.

A page in a browser on the same machine could be served from a name that is re-pointed to 127.0.0.1 (DNS rebinding) and
talk to us; a name cannot be re-pointed when only addresses and known names are accepted. The supervisor binds the
socket once, so that callers wait while the API is restarted.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import re
import socket
from collections.abc import Iterable

from phrases.phrase import Phrase
from service.errors import InputError, printable


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_unread(host: str, where: str, *, vouched: bool, allowed: str) -> None:
    """Raise InputError if others could read the traffic with an address, unless a person states that they cannot.

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


def bind_address(host: str, port: int, *, option: str = "--port", backlog: int = 0) -> socket.socket:
    """Bind an address; InputError if that is impossible.

    option  : which one sets the port
    backlog : listen at once, with a queue of this length; 0: do not listen yet, and another process may still bind the
              address
    """
    try:
        family, kind, proto, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise InputError(f"--host {host}: {(error.strerror or str(error)).lower()}") from None
    listener = socket.socket(family, kind, proto)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        if backlog:
            listener.listen(backlog)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"{option} {port} on {host} is in use; allowed: a free port, or 0 for any") from None
        raise InputError(f"--host {host} {option} {port}: {(error.strerror or str(error)).lower()}") from None
    return listener


def url_of(listener: socket.socket) -> str:
    """Return the address at which a person on this computer finds the server."""
    return f"http://{_authority(*_nearest(listener))}"


def is_answering(listener: socket.socket, path: str, *, timeout_s: float) -> bool:
    """Return whether GET of the path returns 200. Any other answer, or none in time, is False."""
    return _fetch(listener, path, timeout_s, most_bytes=64).split(b" ")[1:2] == [b"200"]


def read_complaint(listener: socket.socket, path: str, *, timeout_s: float) -> str | None:
    """Return the problem that /readyz reports, e.g. `disk: 3 MB are free`; None if it reports none."""
    body = _fetch(listener, path, timeout_s, most_bytes=65536).partition(b"\r\n\r\n")[2]
    try:
        checks = json.loads(body)["checks"]
        return "; ".join(printable(f"{name}: {words}") for name, words in checks.items() if words != "ok") or None
    except (ValueError, LookupError, TypeError, AttributeError):
        return None


def _fetch(listener: socket.socket, path: str, timeout_s: float, *, most_bytes: int) -> bytes:
    """Return the beginning of the answer to GET of the path; nothing if none comes in time."""
    host, port = _nearest(listener)
    come = b""
    try:
        with socket.create_connection((host, port), timeout=timeout_s) as link:
            link.sendall(
                f"GET {path} HTTP/1.1\r\nHost: {_authority(host, port)}\r\nConnection: close\r\n\r\n".encode("ascii")
            )
            while len(come) < most_bytes and (piece := link.recv(most_bytes)):
                come += piece
    except OSError:
        pass
    return come


def _nearest(listener: socket.socket) -> tuple[str, int]:
    host, port = listener.getsockname()[:2]
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host), port


def _authority(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
