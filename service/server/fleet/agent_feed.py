"""The event stream of one agent, read once for all followers of its runs, because an agent has room for few readers.

Theory of operation: one task reads as long as there are followers, and hands each message to all of them. A reader that
comes back with the id of its last event asks the agent itself for the events that it missed (only a few readers do so
at a time), while its queue already fills; events in the queue that it has by then are skipped. When the stream breaks
all readers end with the error, and come back in the same way.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any

from service.http.event_hub import Hub, Message, Reader
from service.http.problems import ServerCode

AGAIN_S = (0.2, 0.5, 1.0, 2.0)  # pauses before a broken stream is opened again
_EVENT_ID = re.compile(r"[0-9a-f]{1,16}-[0-9]{1,15}")
_MOST_WAITING = 1000
_MOST_READERS = 1000  # of one mill; the fleet allows fewer in all
_CATCH_UP = 4  # connections in addition to the shared one
_HEARTBEAT = Message("", "")

Opened = Callable[[str], AbstractAsyncContextManager[AsyncIterator[str]]]


class AgentFeed:
    """opened : the agent's event stream after an id, as lines. lost : makes the error for a broken stream."""

    def __init__(self, opened: Opened, lost: Callable[[str, str, Mapping[str, object]], Exception]) -> None:
        self._opened = opened
        self._lost = lost
        self._hub: Hub[Reader] = Hub(readers=_MOST_READERS)
        self._task: asyncio.Task[None] | None = None
        self._status: Message | None = None
        self._catching_up = asyncio.Semaphore(_CATCH_UP)

    async def follow(self, last_id: str) -> AsyncGenerator[Message]:
        """Yield the events after last_id, then the present state, then each new event; end with the error of a broken
        stream.
        """
        reader = Reader(_MOST_WAITING)
        self._hub.add(reader)
        try:
            first = await self._catch_up(last_id) if last_id else [self._status] if self._status else []
            for message in first:
                last_id = message.id or last_id
                yield message
            self._start_reading()
            while (news := await reader.queue.get()) is not None:
                if not _is_known(news.id, last_id):
                    yield news
            raise reader.error or self._lost("this reader does not keep up", ServerCode.AGENT_SILENT, {})
        finally:
            self._hub.remove(reader)
            if not self._hub.readers and self._task is not None:
                self._task.cancel()

    def _start_reading(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._read(), name="agent feed")

    async def _read(self) -> None:
        end = self._lost("the event stream of the agent has ended", ServerCode.AGENT_SILENT, {})
        try:
            async with self._opened("") as lines:
                async for message in _parse(lines):
                    self._status = message if message.kind == "status" else self._status
                    self._hub.send(message, self._hub.readers)
        except Exception as error:  # of any kind: all readers get it, and try again
            words = str(error) or type(error).__name__
            end = self._lost(words, getattr(error, "code", ""), getattr(error, "values", {}))
        finally:
            self._status = None
        for reader in list(self._hub.readers):
            self._hub.end(reader, end)

    async def _catch_up(self, last_id: str) -> list[Message]:
        """Return the missed events and the present state, with which the agent ends its first messages."""
        found: list[Message] = []
        async with self._catching_up, self._opened(last_id) as lines, contextlib.aclosing(_parse(lines)) as messages:
            self._start_reading()
            async for message in messages:
                found.append(message)
                if message.kind == "status" or message is _HEARTBEAT:
                    break
        return found


def parse_event_id(text: str) -> str:
    """Return the text if it is an event id of an agent, otherwise ""."""
    return text if _EVENT_ID.fullmatch(text) else ""


async def iterate_until(
    ending: asyncio.Event, messages: AsyncGenerator[Message], *, tick_s: float | None = None
) -> AsyncGenerator[Message | None]:
    """Yield the messages until the server ends; None each time that none has come for `tick_s`."""
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
    """Yield the messages of a stream, and one without data for each heartbeat."""
    fields: dict[str, str] = {}
    async for line in lines:
        if line.startswith(":"):
            yield _HEARTBEAT
        elif line:
            name, _, value = line.partition(": ")
            fields[name] = value
        elif fields:
            if "data" in fields:
                yield Message(fields.get("event", ""), fields["data"], fields.get("id", ""))
            fields = {}


def _is_known(event_id: str, last_id: str) -> bool:
    """Return whether an event is from the same start of the agent as the reader's last one, and not newer."""
    life, _, number = event_id.partition("-")
    last_life, _, last = last_id.partition("-")
    return bool(last_id) and life == last_life and number.isdigit() and last.isdigit() and int(number) <= int(last)
