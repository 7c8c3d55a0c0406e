"""What happens to jobs, to any number of followers: one poller asks the database for all of them together.

Theory of operation: every follower remembers the last event it was given. The poller asks for what came after the
least of them, for each job that is followed, and hands each follower its part; so history, live events and a reader
that comes back with Last-Event-ID are one and the same case, and nothing can fall between them. A follower whose
queue is full is dropped: its client may come back and goes on where it was. Only the poller's queries run in another
thread; everything else belongs to the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, field

import structlog
from sqlalchemy.exc import SQLAlchemyError

from service.http.streaming import compact_json, event_bytes
from service.server.database.events import BATCH, MOST_NEWS
from service.server.database.jobs import JobBook
from service.server.database.records import JobEvent, News, Progress
from service.server.schemas.base import iso_time

_POLL_S = 0.25
_AFTER_ERROR_S = 2.0
_QUEUE = 12 * BATCH  # more than one poll brings at most
_log = structlog.get_logger("api")


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
