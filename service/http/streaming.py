"""An answer that is held open for events: given up when the other side is gone or reads nothing."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine

from starlette.types import Receive, Send

_SEND_WAIT_S = 20.0


async def sent(send: Send, body: bytes, *, more: bool = True) -> None:
    """Send a piece; TimeoutError where the other side has not read for long."""
    await asyncio.wait_for(send({"type": "http.response.body", "body": body, "more_body": more}), _SEND_WAIT_S)


async def while_connected(receive: Receive, writing: Coroutine[None, None, None]) -> None:
    """Write until all is written or the other side is gone; both tasks have ended when this returns."""
    tasks = (asyncio.ensure_future(_await_disconnect(receive)), asyncio.ensure_future(writing))
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, TimeoutError, OSError):
                await task


async def _await_disconnect(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
