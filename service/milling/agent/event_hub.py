"""Server-sent events: what happens at the mill, to any number of readers, none of whom can hold the mill up.

Every message has an id `<life>-<number>`; `life` is new at each start of the agent. A reader that comes back with
Last-Event-ID gets what it missed as far as the ring reaches, and a `gap` event where it does not. Of statuses only the
latest counts, so those are not kept: a reader always begins with one. A reader that does not keep up is dropped and
may come back.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections import deque
from dataclasses import dataclass, field

from starlette.types import Receive, Scope, Send

from phrases.phrase import Phrase
from service.http.problems import Problem, problem_response
from service.http.streaming import PING, begin_events, compact_json, event_bytes, send_piece, write_while_connected

_QUEUE = 256


@dataclass(frozen=True, slots=True)
class HubMessage:
    number: int
    kind: str  # "status" or "event"
    data: str  # JSON


@dataclass(eq=False, slots=True)
class Reader:
    """One open connection. `queue` takes None as the end; a status that waits is replaced by a newer one."""

    queue: asyncio.Queue[HubMessage | None] = field(default_factory=lambda: asyncio.Queue(_QUEUE + 1))
    dropped: bool = False


class Hub:
    """Hands messages to readers; all calls from the event loop's thread."""

    def __init__(self, *, ring: int, readers: int) -> None:
        self.life = secrets.token_hex(4)
        self._number = 0
        self._ring: deque[HubMessage] = deque(maxlen=ring)
        self._status: HubMessage | None = None
        self._forgotten = 0  # number of the last event that fell out of the ring
        self._readers: set[Reader] = set()
        self._most = readers
        self._closed = False

    def publish_status(self, data: dict[str, object]) -> None:
        self._status = self._make_message("status", data)
        self._send(self._status)

    def publish_event(self, data: dict[str, object]) -> None:
        message = self._make_message("event", data)
        if len(self._ring) == self._ring.maxlen:
            self._forgotten = self._ring[0].number
        self._ring.append(message)
        self._send(message)

    def join(self, last_id: str) -> tuple[Reader, list[HubMessage]]:
        """Add a reader, and return it with what it is to be sent first."""
        if self._closed or len(self._readers) >= self._most:
            raise Problem(
                503,
                Phrase(
                    "{count} readers already; allowed: {most}. Close one and try again",
                    count=len(self._readers),
                    most=self._most,
                ),
            )
        reader = Reader()
        self._readers.add(reader)
        return reader, self._list_missed(last_id) + ([self._status] if self._status else [])

    def leave(self, reader: Reader) -> None:
        self._readers.discard(reader)

    def close(self) -> None:
        """End all streams; the agent stops."""
        self._closed = True
        for reader in list(self._readers):
            self._drop(reader)

    def encode_message(self, message: HubMessage) -> bytes:
        return event_bytes(message.kind, message.data, f"{self.life}-{message.number}" if message.number else "")

    def _list_missed(self, last_id: str) -> list[HubMessage]:
        life, _, number = last_id.partition("-")
        if not last_id:
            return []
        if life != self.life or not number.isdigit():
            return [_gap(Phrase("the agent was restarted")), *self._ring]
        seen = int(number)
        missed = [message for message in self._ring if message.number > seen]
        return [_gap(Phrase("older events are no longer kept")), *missed] if self._forgotten > seen else missed

    def _make_message(self, kind: str, data: dict[str, object]) -> HubMessage:
        self._number += 1
        return HubMessage(self._number, kind, compact_json(data))

    def _send(self, message: HubMessage) -> None:
        for reader in list(self._readers):
            if reader.queue.qsize() >= _QUEUE:
                self._drop(reader)
            elif message.kind != "status" or reader.queue.qsize() < _QUEUE // 4:  # a late reader skips statuses
                reader.queue.put_nowait(message)

    def _drop(self, reader: Reader) -> None:
        reader.dropped = True
        self._readers.discard(reader)
        with contextlib.suppress(asyncio.QueueFull):
            reader.queue.put_nowait(None)


class HubStream:
    """The response to GET /v1/events: an ASGI app of its own, because a stuck connection must be given up."""

    def __init__(self, hub: Hub, last_id: str, *, heartbeat_s: float) -> None:
        self._hub = hub
        self._last_id = last_id
        self._heartbeat_s = heartbeat_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            reader, first = self._hub.join(self._last_id)
        except Problem as problem:
            await problem_response(problem)(scope, receive, send)
            return
        try:
            await write_while_connected(receive, self._write(reader, first, send))
        finally:
            self._hub.leave(reader)

    async def _write(self, reader: Reader, first: list[HubMessage], send: Send) -> None:
        await begin_events(send, b"".join(map(self._hub.encode_message, first)))
        while not (reader.dropped and reader.queue.empty()):
            try:
                message = await asyncio.wait_for(reader.queue.get(), self._heartbeat_s)
            except TimeoutError:
                await send_piece(send, PING)
                continue
            if message is None:
                break
            await send_piece(send, self._hub.encode_message(message))
        await send_piece(send, b"", more=False)


def _gap(words: str) -> HubMessage:
    return HubMessage(0, "event", compact_json({"kind": "gap", "words": words}))
