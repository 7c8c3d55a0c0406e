"""Server-sent events: their format, and an answer that is held open for them and closed when the other side is gone or
stops reading.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Coroutine

from starlette.types import Receive, Send

EVENT_HEADERS = {
    "Content-Type": "text/event-stream; charset=utf-8",
    "Cache-Control": "no-store",
    "X-Accel-Buffering": "no",
}
FIRST = b"retry: 1000\n\n"
PING = b": still here\n\n"
HEARTBEAT_S = 15.0  # longest silence of a stream; page/lib/sse.js reconnects after three of them
_SEND_WAIT_S = 20.0


def event_bytes(kind: str, data: str, event_id: str = "") -> bytes:
    """Return an event. data: JSON in one line; event_id: sent back by a reader that reconnects, empty for an event that
    is not repeated.
    """
    number = f"id: {event_id}\n" if event_id else ""
    return f"{number}event: {kind}\ndata: {data}\n\n".encode()


def compact_json(data: object) -> str:
    return json.dumps(data, separators=(",", ":"))


async def begin_events(send: Send, first: bytes = b"") -> None:
    """Send the headers, and the bytes that precede the first event."""
    headers = [(name.lower().encode(), value.encode()) for name, value in EVENT_HEADERS.items()]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send_piece(send, FIRST + first)


async def send_piece(send: Send, body: bytes, *, more: bool = True) -> None:
    """Send a piece; TimeoutError if the other side has not read for long."""
    await asyncio.wait_for(send({"type": "http.response.body", "body": body, "more_body": more}), _SEND_WAIT_S)


async def write_while_connected(receive: Receive, writing: Coroutine[None, None, None]) -> None:
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
