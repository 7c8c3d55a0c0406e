"""Sends the events of jobs to any number of followers: one poller queries the database for all of them together.

Theory of operation: every follower remembers the last event that it was given. For each followed job, the poller asks
for the events after the lowest of these and gives each follower its part. So history, live events and a reader that
comes back with Last-Event-ID are the same case, and no event can be lost between them. Only the poller's queries
run in another thread; everything else belongs to the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping, Sequence

import structlog
from sqlalchemy.exc import SQLAlchemyError

from service.http.event_hub import HEARTBEAT_S, Hub, HubStream, Message, Reader, compact_json
from service.http.schema import iso_time
from service.server.database.job_rows import BATCH, MOST_NEWS
from service.server.database.jobs import JobBook
from service.server.database.records import JobEvent, News, Progress, UnknownJobError

_POLL_S = 0.25
_MOST_FOLLOWERS = 500
_AFTER_ERROR_S = 2.0
_MOST_WAITING = 12 * BATCH  # more than one poll brings at most
_log = structlog.get_logger("api")


class Follower(Reader):
    """seen: seq of the last event in its queue; progress: the last value that was sent."""

    def __init__(self, job_id: str, seen: int) -> None:
        super().__init__(_MOST_WAITING)
        self.job_id = job_id
        self.seen = seen
        self.progress: tuple[str, float, float] | None = None


class Feed:
    """All followers of this process."""

    def __init__(self, book: JobBook) -> None:
        self._book = book
        self._hub: Hub[Follower] = Hub(readers=_MOST_FOLLOWERS)
        self._wake = asyncio.Event()
        self._poller: asyncio.Task[None] | None = None

    @property
    def full(self) -> bool:
        return self._hub.full

    @property
    def followers(self) -> int:
        return len(self._hub.readers)

    def stream(self, job_id: str, after: int, *, heartbeat_s: float = HEARTBEAT_S) -> HubStream:
        """Return the answer that sends every event of a job after `after`, to the end."""

        def join() -> list[Message]:
            self._hub.add(follower)
            if self._poller is None or self._poller.done():
                self._poller = asyncio.create_task(self._poll(), name="job feed")
            self._wake.set()
            return []

        async def is_there() -> bool:
            return await asyncio.to_thread(self._is_known, job_id)

        follower = Follower(job_id, after)
        return HubStream(self._hub, follower, join, heartbeat_s=heartbeat_s, is_there=is_there)

    def close(self) -> None:
        """End every stream, now and later: the server stops."""
        self._hub.close()
        self._wake.set()

    def drop_job(self, job_id: str) -> None:
        """Drop the followers of a job that was deleted here."""
        for follower in [each for each in self._hub.readers if each.job_id == job_id]:
            self._hub.end(follower)

    def _is_known(self, job_id: str) -> bool:
        """Return False for a job that was deleted by another process."""
        try:
            self._book.get(job_id)
        except UnknownJobError:
            return False
        except Exception:  # the database may be away; then nothing is known
            return True
        return True

    async def _poll(self) -> None:
        """Poll until there are no more followers."""
        while self._hub.readers:
            self._wake.clear()
            asked = self._list_wanted()
            wait_s = _POLL_S
            try:
                found = await asyncio.to_thread(self._book.read_news, asked)
            except (SQLAlchemyError, OSError) as error:
                _log.warning("feed", error=str(error)[:200])
                wait_s = _AFTER_ERROR_S
            else:
                whole = len(found.events) < MOST_NEWS
                self._hand_out(asked, found, whole=whole)
                wait_s = _POLL_S if whole else 0.0
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), wait_s)

    def _list_wanted(self) -> dict[str, int]:
        """Return, for each job, the event after which a follower needs the rest."""
        asked: dict[str, int] = {}
        for follower in self._hub.readers:
            asked[follower.job_id] = min(follower.seen, asked.get(follower.job_id, follower.seen))
        return asked

    def _hand_out(self, asked: Mapping[str, int], news: News, *, whole: bool) -> None:
        """Give each follower the events that it has not seen. `whole`: no events were left in the database."""
        events: dict[str, list[JobEvent]] = {}
        for event in news.events:
            events.setdefault(event.job_id, []).append(event)
        for follower in [each for each in self._hub.readers if each.job_id in asked]:
            self._hand_events(follower, events.get(follower.job_id, []), whole=whole)
            if whole and follower.job_id in news.progress:
                self._hand_progress(follower, news.progress[follower.job_id])

    def _hand_events(self, follower: Follower, events: Sequence[JobEvent], *, whole: bool) -> None:
        for event in events:
            if event.seq > follower.seen:
                follower.seen = event.seq
                data = compact_json(event.data | {"at": iso_time(event.at)})
                self._hub.send(Message(event.kind, data, str(event.seq)), [follower])
                if whole and event.kind == "ended" and event is events[-1]:  # otherwise it has been retried since
                    self._hub.end(follower)

    def _hand_progress(self, follower: Follower, now: Progress) -> None:
        shown = (now.stage, now.share, now.progress)
        if shown != follower.progress:
            follower.progress = shown
            data = {"stage": now.stage, "share": round(now.share, 4), "progress": round(now.progress, 4)}
            self._hub.send(Message("progress", compact_json(data)), [follower])
