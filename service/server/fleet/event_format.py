"""What the event streams of runs and of machines have in common: waiting with an end, and the form of an event."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncGenerator
from typing import Any

from service.server.fleet.agent_feed import Message

PING = b": still here\n\n"
FIRST = b"retry: 1000\n\n"
AGAIN_S = (0.2, 0.5, 1.0, 2.0)  # after so long a broken stream is asked for again
_EVENT_ID = re.compile(r"[0-9a-f]{1,16}-[0-9]{1,15}")

Json = dict[str, Any]


def known_id(text: str) -> str:
    """The id of an event as agents give them; nothing for any other text."""
    return text if _EVENT_ID.fullmatch(text) else ""


def event_bytes(kind: str, data: Json, event_id: str = "") -> bytes:
    number = f"id: {event_id}\n" if event_id else ""
    return f"{number}event: {kind}\ndata: {json.dumps(data, separators=(',', ':'))}\n\n".encode()


async def until(
    ending: asyncio.Event, messages: AsyncGenerator[Message], *, tick_s: float | None = None
) -> AsyncGenerator[Message | None]:
    """The messages, as long as the server does not end; None each time that none has come for `tick_s`."""
    over = asyncio.ensure_future(ending.wait())
    step: asyncio.Future[Message | None] | None = None
    try:
        while not over.done():
            step = step or asyncio.ensure_future(anext(messages, None))
            pending: set[asyncio.Future[Any]] = {step, over}
            await asyncio.wait(pending, timeout=tick_s, return_when=asyncio.FIRST_COMPLETED)
            if not step.done():
                yield None
                continue
            message, step = step.result(), None
            if message is None:
                return
            yield message
    finally:
        for waiting in (over, step):
            if waiting is not None:
                waiting.cancel()
                await asyncio.gather(waiting, return_exceptions=True)
        await messages.aclose()
