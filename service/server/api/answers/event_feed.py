"""What happens to jobs, to any number of followers: one poller asks the database for all of them together.

Theory of operation: every follower remembers the last event it was given. The poller asks for what came after the least
of them, for each job that is followed, and hands each follower its part; so history, live events and a reader that
comes back with Last-Event-ID are one and the same case, and nothing can fall between them. A follower whose queue is
full is dropped: its client may come back and goes on where it was. Only the poller's queries run in another thread;
everything else belongs to the event loop. A connection that is stuck must be given up, so the answer that a follower
holds open is ASGI of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, field

import structlog
from sqlalchemy.exc import SQLAlchemyError
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.http.schema import iso_time
from service.http.streaming import (
    HEARTBEAT_S,
    PING,
    begin_events,
    compact_json,
    event_bytes,
    send_piece,
    write_while_connected,
)
from service.server.database.job_rows import BATCH, MOST_NEWS
from service.server.database.jobs import JobBook
from service.server.database.records import JobEvent, News, Progress, UnknownJobError

_POLL_S = 0.25
_AFTER_ERROR_S = 2.0
_QUEUE = 12 * BATCH  # more than one poll brings at most
_log = structlog.get_logger("api")
_MOST_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class Message:
    """One event as it is sent; seq 0: progress, which is not counted and not repeated. `last`: nothing follows."""

    text: bytes
    seq: int = 0
    last: bool = False


@dataclass(eq=False, slots=True)
class Follower:
    job_id: str
    seen: int  # seq of the last event in its queue
    progress: tuple[str, float, float] | None = None  # the last that was shown
    queue: asyncio.Queue[Message | None] = field(default_factory=lambda: asyncio.Queue(_QUEUE))  # None: the end


class Feed:
    """All followers of this process. `most` bounds them."""

    def __init__(self, book: JobBook, *, most: int = 500, poll_s: float = _POLL_S) -> None:
        self._book = book
        self._most = most
        self._poll_s = poll_s
        self._followers: set[Follower] = set()
        self._wake = asyncio.Event()
        self._poller: asyncio.Task[None] | None = None
        self._closed = False

    @property
    def full(self) -> bool:
        return self._closed or len(self._followers) >= self._most

    @property
    def followers(self) -> int:
        return len(self._followers)

    @contextlib.asynccontextmanager
    async def follow(self, job_id: str, after: int) -> AsyncIterator[Follower]:
        """Yield a follower that gets every event after `after`, and the end."""
        follower = Follower(job_id, after)
        self._followers.add(follower)
        if self._closed:
            self._drop(follower)
        if self._poller is None or self._poller.done():
            self._poller = asyncio.create_task(self._poll(), name="job feed")
        self._wake.set()
        try:
            yield follower
        finally:
            self._followers.discard(follower)

    def close(self) -> None:
        """End every stream, now and later: the server stops."""
        self._closed = True
        for follower in list(self._followers):
            self._drop(follower)
        self._wake.set()

    def drop_job(self, job_id: str) -> None:
        """Drop the followers of a job that was deleted here."""
        for follower in [each for each in self._followers if each.job_id == job_id]:
            self._drop(follower)

    async def _poll(self) -> None:
        """Poll until nobody follows any more."""
        while self._followers:
            self._wake.clear()
            asked = self._list_wanted()
            wait_s = self._poll_s
            try:
                found = await asyncio.to_thread(self._book.read_news, asked)
            except (SQLAlchemyError, OSError) as error:
                _log.warning("feed", error=str(error)[:200])
                wait_s = _AFTER_ERROR_S
            else:
                whole = len(found.events) < MOST_NEWS
                self._hand_out(asked, found, whole=whole)
                wait_s = self._poll_s if whole else 0.0
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), wait_s)

    def _list_wanted(self) -> dict[str, int]:
        """Return for each job the event after which somebody needs the rest."""
        asked: dict[str, int] = {}
        for follower in self._followers:
            asked[follower.job_id] = min(follower.seen, asked.get(follower.job_id, follower.seen))
        return asked

    def _hand_out(self, asked: Mapping[str, int], news: News, *, whole: bool) -> None:
        """Hand each follower what it has not seen. `whole`: nothing was left behind in the database."""
        events: dict[str, list[JobEvent]] = {}
        for event in news.events:
            events.setdefault(event.job_id, []).append(event)
        for follower in [each for each in self._followers if each.job_id in asked]:
            self._hand_events(follower, events.get(follower.job_id, []), whole=whole)
            if whole and follower.job_id in news.progress:
                self._hand_progress(follower, news.progress[follower.job_id])

    def _hand_events(self, follower: Follower, events: Sequence[JobEvent], *, whole: bool) -> None:
        for event in events:
            if event.seq > follower.seen:
                last = whole and event.kind == "ended" and event is events[-1]  # else it was retried since
                self._give(follower, Message(_text_of(event), event.seq, last))
                follower.seen = event.seq

    def _hand_progress(self, follower: Follower, now: Progress) -> None:
        shown = (now.stage, now.share, now.progress)
        if shown != follower.progress:
            follower.progress = shown
            data = {"stage": now.stage, "share": round(now.share, 4), "progress": round(now.progress, 4)}
            self._give(follower, Message(event_bytes("progress", compact_json(data))))

    def _give(self, follower: Follower, message: Message) -> None:
        if follower not in self._followers:
            return
        if follower.queue.full():
            self._drop(follower)
        else:
            follower.queue.put_nowait(message)

    def _drop(self, follower: Follower) -> None:
        self._followers.discard(follower)
        if follower.queue.full():
            # All of it: what is sent must have no gap, as a client that comes back asks for what follows the last.
            while not follower.queue.empty():
                follower.queue.get_nowait()
        follower.queue.put_nowait(None)


def _text_of(event: JobEvent) -> bytes:
    return event_bytes(event.kind, compact_json(event.data | {"at": iso_time(event.at)}), str(event.seq))


class EventStream(Response):
    """The answer that a follower of a job holds open: sends what the feed hands to it."""

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
