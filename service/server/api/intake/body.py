"""The body of a request, piece by piece, within time limits; and what is left of it when it is refused."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections.abc import AsyncIterator

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from phrases.phrase import Phrase
from service.http.problems import Problem

_CHUNK_WAIT_S = 30.0
_SLOWEST_BYTES_PER_S = 10_000
_SMALL_BYTES = 64 << 10
_LINGER_S = 2.0
_LINGER_BYTES = 8_000_000
_PIECE_S = 30.0  # without a byte of a body that is under way
_TAKEN_S = 300.0  # for a piece of a megabyte at most: a line of 4 kB/s is not given up


class RequestBody:
    """Read once, by `pieces`."""

    def __init__(self, request: Request, *, wait_s: float = _CHUNK_WAIT_S) -> None:
        self._request = request
        self._wait_s = wait_s
        self._more = True

    async def pieces(self) -> AsyncIterator[bytes]:
        """Yield the body; Problem 408 for a client that stops sending, or drips; ClientDisconnect for one that goes."""
        began, taken = time.monotonic(), 0
        while self._more:
            try:
                async with asyncio.timeout(self._wait_s):
                    piece = await self._receive_piece()
            except TimeoutError:
                words = Phrase("the request stopped arriving; nothing came for {wait_s:g} s", wait_s=self._wait_s)
                raise Problem(408, words) from None
            taken += len(piece)
            if time.monotonic() - began > 2 * self._wait_s + taken / _SLOWEST_BYTES_PER_S:
                words = Phrase(
                    "{count} bytes in {seconds:.0f} s are too slow; allowed: {least} kB/s at least",
                    count=taken,
                    seconds=time.monotonic() - began,
                    least=_SLOWEST_BYTES_PER_S // 1000,
                )
                raise Problem(408, words)
            yield piece

    async def linger(self) -> None:
        """Read a little of what a refused client still sends: if closed at once, it could lose the answer."""
        if "expect" in self._request.headers:
            return
        taken = 0
        with contextlib.suppress(TimeoutError, ClientDisconnect):
            async with asyncio.timeout(_LINGER_S):
                while self._more and taken < _LINGER_BYTES:
                    taken += len(await self._receive_piece())

    async def _receive_piece(self) -> bytes:
        message = await self._request.receive()
        if message["type"] != "http.request":
            self._more = False
            raise ClientDisconnect
        self._more = bool(message.get("more_body"))
        return bytes(message.get("body", b""))


class BodyLimit:
    """ASGI middleware: no body is longer than 64 kB, but those posted to some addresses, which count for themselves.

    but : a pattern of those addresses
    """

    def __init__(self, app: ASGIApp, *, but: re.Pattern[str]) -> None:
        self._app = app
        self._but = but

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (scope["method"] == "POST" and self._but.fullmatch(scope["path"])):
            await self._app(scope, receive, send)
            return
        taken = 0

        async def receive_counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > _SMALL_BYTES:
                raise HTTPException(413)  # the framework passes this one on, and makes 400 of all others
            return message

        await self._app(scope, receive_counted, send)


class BodyTimeout:
    """ASGI middleware: 408 for a body that stops coming, an end for a connection that stops reading."""

    def __init__(self, app: ASGIApp, *, piece_s: float = _PIECE_S, taken_s: float = _TAKEN_S) -> None:
        self._app = app
        self._piece_s = piece_s
        self._taken_s = taken_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        coming = True

        async def receive_in_time() -> Message:
            nonlocal coming
            if not coming:  # only the end of the connection is waited for
                return await receive()
            try:
                async with asyncio.timeout(self._piece_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, headers={"Connection": "close"}) from None
            coming = bool(message.get("more_body"))
            return message

        async def send_in_time(message: Message) -> None:
            async with asyncio.timeout(self._taken_s):
                await send(message)

        await self._app(scope, receive_in_time, send_in_time)
