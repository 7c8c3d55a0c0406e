"""Reads the headers of a request, and refuses requests that a page of another site makes a browser send."""

from __future__ import annotations

from collections import Counter

from starlette.types import Scope

from phrases.phrase import Phrase
from service.http.hosts import is_own_host
from service.http.problems import Problem
from service.http.uvicorn_protocol import HEADER_BYTES
from service.server.api.access.client_address import is_here

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
    """Refuse a page of another site, which can make a browser send us things; the browser says so.

    We speak HTTP; a page can have come by HTTPS only where there is a proxy.
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
