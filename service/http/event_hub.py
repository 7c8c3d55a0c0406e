"""Server-sent events: their format, and their delivery to any number of readers, none of which can hold up the
publisher or another reader.

Theory of operation: a response stays open for events, and is closed when the other side is gone or stops reading. Every
reader has its own bounded queue. A reader whose queue is full is ended: it is sent the contents of its queue, in order
and without a gap, and then the end, so that its client comes back with Last-Event-ID and continues where it was. Only
the latest status counts, so a slow reader skips some. A hub with a ring gives its messages ids `<life>-<number>`, with
a new `life` for each hub. It repeats the missed messages to a reader that comes back, as far as the ring reaches, and
sends a `gap` event if it does not.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from phrases.phrase import Phrase
from service.http.problems import Problem, problem_response

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
    """Write until everything is written or the other side is gone; both tasks have ended when this returns."""
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


MOST_WAITING = 256
_MOST_AT_ONCE = 64
_STATUS = "status"


@dataclass(frozen=True, slots=True)
class Message:
    """data: JSON in one line; id: sent back by a reader that reconnects, empty for an event that is not repeated."""

    kind: str
    data: str
    id: str = ""

    def encode(self) -> bytes:
        return event_bytes(self.kind, self.data, self.id)


class Reader:
    """A reader. None in `queue` is the end; error: its reason, unless the reader was too slow."""

    def __init__(self, most_waiting: int = MOST_WAITING) -> None:
        self.most_waiting = most_waiting
        self.queue: asyncio.Queue[Message | None] = asyncio.Queue(most_waiting + 1)  # one more for the end
        self.error: Exception | None = None


AReader = TypeVar("AReader", bound=Reader)


class Hub(Generic[AReader]):
    """Hands messages to readers; all calls from the event loop's thread."""

    def __init__(self, *, ring: int = 0, readers: int) -> None:
        self.life = secrets.token_hex(4)
        self.readers: set[AReader] = set()
        self._number = 0
        self._ring: deque[tuple[int, Message]] = deque(maxlen=ring)
        self._status: Message | None = None
        self._forgotten = 0  # number of the last event that left the ring
        self._most = readers
        self._closed = False

    @property
    def full(self) -> bool:
        return self._closed or len(self.readers) >= self._most

    def add(self, reader: AReader, last_id: str = "") -> list[Message]:
        """Add a reader, and return the messages that it gets first. Problem 503 if there are too many readers."""
        if self.full:
            raise Problem(
                503,
                Phrase(
                    "{count} readers already; allowed: {most}. Close one and try again",
                    count=len(self.readers),
                    most=self._most,
                ),
            )
        self.readers.add(reader)
        return self._list_missed(last_id) + ([self._status] if self._status else [])

    def remove(self, reader: AReader) -> None:
        self.readers.discard(reader)

    def publish_status(self, data: dict[str, object]) -> None:
        self._status = self._make_message(_STATUS, data)
        self.send(self._status, self.readers)

    def publish_event(self, data: dict[str, object]) -> None:
        message = self._make_message("event", data)
        if self._ring and len(self._ring) == self._ring.maxlen:
            self._forgotten = self._ring[0][0]
        self._ring.append((self._number, message))
        self.send(message, self.readers)

    def send(self, message: Message, to: Iterable[AReader]) -> None:
        for reader in [reader for reader in to if reader in self.readers]:
            waiting = reader.queue.qsize()
            if waiting >= reader.most_waiting:
                self.end(reader)
            elif message.kind != _STATUS or waiting < reader.most_waiting // 4:
                reader.queue.put_nowait(message)

    def end(self, reader: AReader, error: Exception | None = None) -> None:
        """End a reader after the contents of its queue."""
        if reader in self.readers:
            self.readers.discard(reader)
            reader.error = error
            reader.queue.put_nowait(None)

    def close(self) -> None:
        """End all readers, now and later."""
        self._closed = True
        for reader in list(self.readers):
            self.end(reader)

    def _list_missed(self, last_id: str) -> list[Message]:
        life, _, number = last_id.partition("-")
        if not last_id:
            return []
        if life != self.life or not number.isdigit():
            return [_gap(Phrase("the agent was restarted")), *(message for _, message in self._ring)]
        seen = int(number)
        missed = [message for number, message in self._ring if number > seen]
        return [_gap(Phrase("older events are no longer kept")), *missed] if self._forgotten > seen else missed

    def _make_message(self, kind: str, data: dict[str, object]) -> Message:
        self._number += 1
        return Message(kind, compact_json(data), f"{self.life}-{self._number}")


class HubStream(Response):
    """An answer that is held open for a reader of a hub: its own ASGI application, because a stuck connection must be
    given up.

    join     : adds the reader to the hub and returns its first messages
    is_there : checked with each heartbeat; the stream ends if its subject no longer exists
    """

    def __init__(
        self,
        hub: Hub[AReader],
        reader: AReader,
        join: Callable[[], list[Message]],
        *,
        heartbeat_s: float = HEARTBEAT_S,
        is_there: Callable[[], Awaitable[bool]] | None = None,
    ) -> None:
        super().__init__()
        self._reader = reader
        self._join = join
        self._leave = partial(hub.remove, reader)
        self._heartbeat_s = heartbeat_s
        self._is_there = is_there

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            first = self._join()
        except Problem as problem:
            await problem_response(problem)(scope, receive, send)
            return
        try:
            await write_while_connected(receive, self._write(first, send))
        finally:
            self._leave()

    async def _write(self, first: list[Message], send: Send) -> None:
        queue = self._reader.queue
        await begin_events(send, b"".join(message.encode() for message in first))
        going = True
        while going:
            try:
                batch = [await asyncio.wait_for(queue.get(), self._heartbeat_s)]
            except TimeoutError:
                await send_piece(send, PING)
                going = self._is_there is None or await self._is_there()
                continue
            while len(batch) < _MOST_AT_ONCE and not queue.empty():
                batch.append(queue.get_nowait())
            going = batch[-1] is not None
            if text := b"".join(message.encode() for message in batch if message is not None):
                await send_piece(send, text)
        await send_piece(send, b"", more=False)


def _gap(words: str) -> Message:
    return Message("event", compact_json({"kind": "gap", "words": words}))
