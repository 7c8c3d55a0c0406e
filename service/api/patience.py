"""How long a connection may keep us waiting: for the rest of a body, and for its reading what it asked for."""

from __future__ import annotations

import asyncio

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_PIECE_S = 30.0  # without a byte of a body that is under way
_TAKEN_S = 300.0  # for a piece of a megabyte at most: a line of 4 kB/s is not given up


class Patient:
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

        async def received() -> Message:
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

        async def sent(message: Message) -> None:
            async with asyncio.timeout(self._taken_s):
                await send(message)

        await self._app(scope, received, sent)
