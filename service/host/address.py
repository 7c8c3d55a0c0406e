"""The address of the server: bound once by the supervisor, so that callers wait while the API is started again."""

from __future__ import annotations

import errno
import socket

from service.errors import InputError


def bound(host: str, port: int) -> socket.socket:
    """A bound address that does not listen yet; InputError where it cannot be had."""
    try:
        family, kind, proto, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise InputError(f"--host {host}: {(error.strerror or str(error)).lower()}") from None
    listener = socket.socket(family, kind, proto)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"--port {port} on {host} is in use; allowed: a free port, or 0 for any") from None
        raise InputError(f"--host {host} --port {port}: {(error.strerror or str(error)).lower()}") from None
    return listener


def url_of(listener: socket.socket) -> str:
    """Where a person on this computer finds it."""
    return f"http://{_authority(*_nearest(listener))}"


def answers(listener: socket.socket, path: str, *, patience_s: float) -> bool:
    """True where GET of the path is answered with 200. Any other answer, or none in time, is False."""
    host, port = _nearest(listener)
    try:
        with socket.create_connection((host, port), timeout=patience_s) as link:
            link.sendall(f"GET {path} HTTP/1.0\r\nHost: {_authority(host, port)}\r\n\r\n".encode("ascii"))
            return link.recv(64).split(b" ")[1:2] == [b"200"]
    except OSError:
        return False


def _nearest(listener: socket.socket) -> tuple[str, int]:
    host, port = listener.getsockname()[:2]
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host), port


def _authority(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
