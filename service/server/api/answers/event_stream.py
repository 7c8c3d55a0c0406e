"""The answer that a follower of a job holds open: ASGI of its own, because a stuck connection must be given up."""

from __future__ import annotations

import asyncio
import contextlib

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.http.streaming import HEARTBEAT_S, PING, begin_events, send_piece, write_while_connected
from service.server.api.answers.event_feed import Feed, Follower
from service.server.database.jobs import JobBook
from service.server.database.records import UnknownJobError

_MOST_AT_ONCE = 64


class EventStream(Response):
    """Sends what the feed hands to one follower."""

    def __init__(self, feed: Feed, book: JobBook, job_id: str, after: int, *, heartbeat_s: float = HEARTBEAT_S) -> None:
        super().__init__()
        self._feed = feed
        self._book = book
        self._job_id = job_id
        self._after = after
        self._heartbeat_s = heartbeat_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with self._feed.follow(self._job_id, self._after) as follower:
            await write_while_connected(receive, self._write(follower, send))

    async def _write(self, follower: Follower, send: Send) -> None:
        await begin_events(send)
        going = True
        while going:
            try:
                message = await asyncio.wait_for(follower.queue.get(), self._heartbeat_s)
            except TimeoutError:
                await send_piece(send, PING)
                going = await self._still_there()
                continue
            texts: list[bytes] = []
            while message is not None and not message.last and len(texts) < _MOST_AT_ONCE:
                texts.append(message.text)
                if follower.queue.empty():
                    break
                message = follower.queue.get_nowait()
            else:
                going = message is not None and not message.last
                texts.extend([] if message is None else [message.text])
            await send_piece(send, b"".join(texts))
        await send_piece(send, b"", more=False)

    async def _still_there(self) -> bool:
        """Return False for a job that was deleted by another process."""
        with contextlib.suppress(Exception):  # the database may be away; then nothing is known
            try:
                await asyncio.to_thread(self._book.get, self._job_id)
            except UnknownJobError:
                return False
        return True
