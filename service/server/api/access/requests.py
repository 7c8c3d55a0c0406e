"""Reads and checks the head of a request: its origin (this computer, or an address, which a proxy may have to supply),
its token, and whether a page of another site made a browser send it, which is refused. Also limits the size and the
time of its body.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
from collections import Counter
from collections.abc import Mapping

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from phrases.phrase import Phrase
from service.http.hosts import is_loopback, is_own_host
from service.http.problems import Problem
from service.http.uvicorn_protocol import HEADER_BYTES

_SMALL_BYTES = 64 << 10
_PIECE_S = 30.0  # time without a byte of a body that is under way
_TAKEN_S = 300.0  # for a piece of at most a megabyte: enough for a line of 4 kB/s
_FORWARDED = frozenset({b"forwarded", b"via", b"x-real-ip"})
_NETWORK_BITS = 64  # of IPv6: the network of one household, or of one attacker
_HERE, _LONGEST = "this computer", 100


def is_here(scope: Scope, headers: Mapping[bytes, bytes]) -> bool:
    """Return whether the caller is on this computer and no proxy has passed its request on. Some proxies only speak
    HTTP/1.0.
    """
    peer = scope.get("client")
    forwarded = any(name in _FORWARDED or name.startswith(b"x-forwarded-") for name in headers)
    direct = not forwarded and scope.get("http_version") != "1.0"
    return peer is not None and is_loopback(peer[0]) and direct


def address_of(scope: Scope, *, behind_proxy: bool) -> str:
    """Return a name for the origin of a request, by which requests are counted; for IPv6, its network.

    Only a proxy that the settings name is trusted, and only the last entry of its header, which it added itself. If a
    proxy adds none, callers can invent addresses, so limits that must hold in that case too must not count by address
    alone.
    """
    headers = dict(scope["headers"])
    if is_here(scope, headers) and not behind_proxy:
        return _HERE
    peer = scope.get("client")
    named = headers.get(b"x-forwarded-for", b"").decode("latin-1").rpartition(",")[2].strip() if behind_proxy else ""
    return _network(named) or f"by way of {peer[0] if peer else 'nobody'}"[:_LONGEST]


def is_this_computer(address: str) -> bool:
    """Return whether a name returned by `address_of` means this computer."""
    return address == _HERE


def _network(text: str) -> str:
    """Return an address as text, or the network of an IPv6 address; "" if it is not an address."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return ""
    if address.version == 4:
        return str(address)
    return str(ipaddress.ip_network((int(address), _NETWORK_BITS), strict=False))


_SINGLE = frozenset(
    {
        b"host",
        b"authorization",
        b"origin",
        b"content-type",
        b"idempotency-key",
        b"last-event-id",
        b"causticmill-control",
        b"causticmill-grant",
    }
)
_MOST_HEADERS = 100

Headers = dict[bytes, bytes]


def read_headers(scope: Scope, names: frozenset[str]) -> Headers:
    """Return the headers as a table. Problem if there are too many, if one that must be unique is repeated, or if Host
    is neither one of the names nor an address.
    """
    headers = _plain_headers(scope)
    host = headers.get(b"host", b"").decode("latin-1").lower()
    if not is_own_host(host, names):
        words = Phrase("Host is '{host}'; allowed: localhost, an address, or a name of this server", host=host[:100])
        raise Problem(403, words)
    return headers


def refuse_foreign_page(scope: Scope, headers: Headers, *, behind_proxy: bool) -> None:
    """Refuse a page of another site, which can make a browser send us things; the browser's headers show it. We serve
    plain HTTP; a page can have come by HTTPS only through a proxy.
    """
    origin, host = (headers.get(name, b"").lower() for name in (b"origin", b"host"))
    schemes = (b"http", b"https") if behind_proxy or not is_here(scope, headers) else (b"http",)
    if b"origin" in headers and origin not in {scheme + b"://" + host for scheme in schemes}:
        words = Phrase("Origin is another site; this server accepts changes only from its own pages")
        raise Problem(403, words, field="Origin")
    if headers.get(b"sec-fetch-site", b"none").lower() not in (b"none", b"same-origin"):
        words = Phrase("another site sent this; this server accepts changes only from its own pages")
        raise Problem(403, words, field="Origin")


def read_secret(headers: Headers) -> str:
    """Return the bearer token; "" if there is none."""
    kind, _, secret = headers.get(b"authorization", b"").decode("latin-1").partition(" ")
    return secret.strip() if kind.lower() == "bearer" else ""


def _plain_headers(scope: Scope) -> Headers:
    pairs = scope["headers"]
    if len(pairs) > _MOST_HEADERS or sum(len(name) + len(value) for name, value in pairs) > HEADER_BYTES:
        raise Problem(
            431, Phrase("allowed: {count} headers of {most} bytes in all", count=_MOST_HEADERS, most=HEADER_BYTES)
        )
    for name, count in Counter(name for name, _ in pairs).items():
        if count > 1 and name in _SINGLE:
            words = Phrase("{count} {name} headers", count=count, name=name.decode())
            raise Problem(400, words, field=name.decode())
    return dict(pairs)


class BodyLimits:
    """ASGI middleware: answers 413 to a body longer than 64 kB and 408 to one that stalls, and ends a connection that
    stops reading.

    but : a pattern of paths whose handlers limit their bodies themselves
    """

    def __init__(
        self, app: ASGIApp, *, but: re.Pattern[str], piece_s: float = _PIECE_S, taken_s: float = _TAKEN_S
    ) -> None:
        self._app = app
        self._but = but
        self._piece_s = piece_s
        self._taken_s = taken_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        counts = not (scope["method"] == "POST" and self._but.fullmatch(scope["path"]))
        coming, taken = True, 0

        async def receive_within_limits() -> Message:
            nonlocal coming, taken
            if not coming:  # the body is complete: only the end of the connection is awaited
                return await receive()
            try:
                async with asyncio.timeout(self._piece_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, headers={"Connection": "close"}) from None
            coming = bool(message.get("more_body"))
            taken += len(message.get("body", b""))
            if counts and taken > _SMALL_BYTES:
                raise HTTPException(413)  # the framework passes this exception on, and turns all others into 400
            return message

        async def send_in_time(message: Message) -> None:
            async with asyncio.timeout(self._taken_s):
                await send(message)

        await self._app(scope, receive_within_limits, send_in_time)
