"""The event stream of one agent, read once for all who follow its runs: an agent has room for few readers.

Theory of operation: one task reads as long as somebody follows, and puts each message into everybody's queue. Who comes
back with the id of the last event it has asks the agent itself for what it missed, a few at a time, while its queue
fills already; what it finds in there and has by then is left out. When the stream breaks everybody is told so, once,
and comes back in the same way.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any

from service.http.problems import ServerCode

AGAIN_S = (0.2, 0.5, 1.0, 2.0)  # after so long a broken stream is asked for again
_EVENT_ID = re.compile(r"[0-9a-f]{1,16}-[0-9]{1,15}")
_QUEUE = 1000
_CATCH_UP = 4  # connections beside the one

Message = dict[str, str]  # the fields of an event: id, event, data; empty: a heartbeat
End = tuple[str, str, Mapping[str, object]]  # the stream broke: why, in words, and as code and values
Opened = Callable[[str], AbstractAsyncContextManager[AsyncIterator[str]]]


class AgentFeed:
    """opened : the agent's event stream after an id, as lines. lost : makes the error for a broken stream."""

    def __init__(self, opened: Opened, lost: Callable[[str, str, Mapping[str, object]], Exception]) -> None:
        self._opened = opened
        self._lost = lost
        self._queues: set[asyncio.Queue[Message | End]] = set()
        self._reader: asyncio.Task[None] | None = None
        self._status: Message = {}
        self._catching_up = asyncio.Semaphore(_CATCH_UP)

    async def follow(self, last_id: str) -> AsyncGenerator[Message]:
        """Yield those after last_id, then how things stand, then each new one; ends with the error for a broken
        stream.
        """
        queue: asyncio.Queue[Message | End] = asyncio.Queue(_QUEUE)
        self._queues.add(queue)
        try:
            first = await self._catch_up(last_id) if last_id else [self._status] if self._status else []
            for message in first:
                last_id = message.get("id") or last_id
                yield message
            self._start_reading()
            while isinstance(news := await queue.get(), dict):
                if not _is_known(news.get("id", ""), last_id):
                    yield news
            raise self._lost(*news)
        finally:
            self._queues.discard(queue)
            if not self._queues and self._reader is not None:
                self._reader.cancel()

    def _start_reading(self) -> None:
        if self._reader is None or self._reader.done():
            self._reader = asyncio.create_task(self._read(), name="agent feed")

    async def _read(self) -> None:
        end: End = "the event stream of the agent has ended", ServerCode.AGENT_SILENT, {}
        try:
            async with self._opened("") as lines:
                async for message in _parse(lines):
                    self._status = message if message.get("event") == "status" else self._status
                    self._hand_out(message)
        except Exception as error:  # whatever it was: everybody is told, and tries again
            end = str(error) or type(error).__name__, getattr(error, "code", ""), getattr(error, "values", {})
        finally:
            self._status = {}
        self._hand_out(end)

    def _hand_out(self, message: Message | End) -> None:
        for queue in list(self._queues):
            told = message
            if queue.full():
                told = "this reader does not keep up", ServerCode.AGENT_SILENT, {}
                queue.get_nowait()  # it asks for it again
            if isinstance(told, tuple):
                self._queues.discard(queue)
            queue.put_nowait(told)

    async def _catch_up(self, last_id: str) -> list[Message]:
        """Return what has happened since, and how things stand, with which the agent ends what it tells at first."""
        found: list[Message] = []
        async with self._catching_up, self._opened(last_id) as lines, contextlib.aclosing(_parse(lines)) as messages:
            self._start_reading()
            async for message in messages:
                found.append(message)
                if message.get("event") == "status" or not message:
                    break
        return found


def known_id(text: str) -> str:
    """Return the id of an event as agents give them; nothing for any other text."""
    return text if _EVENT_ID.fullmatch(text) else ""


async def iterate_until(
    ending: asyncio.Event, messages: AsyncGenerator[Message], *, tick_s: float | None = None
) -> AsyncGenerator[Message | None]:
    """Yield the messages, as long as the server does not end; None each time that none has come for `tick_s`."""
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


async def _parse(lines: AsyncIterator[str]) -> AsyncGenerator[Message]:
    """Yield the messages of a stream; an empty one for each heartbeat."""
    message: Message = {}
    async for line in lines:
        if line.startswith(":"):
            yield {}
        elif line:
            name, _, value = line.partition(": ")
            message[name] = value
        elif message:
            if "data" in message:
                yield message
            message = {}


def _is_known(event_id: str, last_id: str) -> bool:
    """Return whether an event of the agent's same life is not newer than the last one the reader has."""
    life, _, number = event_id.partition("-")
    last_life, _, last = last_id.partition("-")
    return bool(last_id) and life == last_life and number.isdigit() and last.isdigit() and int(number) <= int(last)
