"""A run's own events, out of the stream of its mill's agent: how it stands, and what has happened at the mill since.

The ids are the agent's, so a reader that comes back with Last-Event-ID, to this server or to the next one, misses
nothing that the agent still has, as long as the run is open. While the agent is away the reader is told so and the
stream goes on; it ends with the run.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import replace
from math import inf

from service.http.problems import Problem
from service.server.database.runs import ENDED, RunRow, read_reason
from service.server.fleet.agent_client import AgentAwayError, as_problem
from service.server.fleet.agent_feed import Message
from service.server.fleet.agent_replies import json_object, run_view, table
from service.server.fleet.core import FleetCore, Seen
from service.server.fleet.event_format import AGAIN_S, FIRST, PING, Json, event_bytes, known_id, until
from service.server.fleet.representation import live_json

_LOOK_S = 1.0


class RunEvents:
    """What one reader of a run is sent."""

    def __init__(self, core: FleetCore, seen: Seen, last_id: str) -> None:
        self._core = core
        self._seen = seen
        self._last_id = last_id
        self._shown = live_json(seen)
        self._looked_s = 0.0
        self._failures = 0

    async def stream(self) -> AsyncGenerator[bytes]:
        """Bytes of the event stream: `run` events hold how it stands, `log` events what happened."""
        core = self._core
        yield FIRST + event_bytes("run", self._shown)
        while self._shown["open"] and not core.ending.is_set():
            away: Problem | None = None
            try:
                async for piece in self._live():
                    yield piece
                if not self._shown["open"]:
                    return
            except (AgentAwayError, Problem) as error:
                away = as_problem(error)
            await core.await_end(AGAIN_S[min(self._failures, len(AGAIN_S) - 1)])
            self._failures += 1
            seen = self._seen = await self._now()
            now = live_json(Seen(seen.run, seen.away or (away if seen.run.agent_run is None else None)))
            yield event_bytes("run", now) if now != self._shown else PING
            self._shown = now

    async def _live(self) -> AsyncIterator[bytes]:
        """As long as the agent's stream goes on and the run has not ended."""
        async for message in until(self._core.ending, _of_agent(self._core, self._seen.run, self._last_id)):
            if message is None:
                continue
            self._failures, self._last_id = 0, known_id(message.get("id", "")) or self._last_id
            for kind, data in _told(self._seen.run, message):
                if kind == "ping":
                    yield PING
                elif kind != "run":
                    yield event_bytes(kind, data, self._last_id)
                elif (now := data or await self._look()) != self._shown:
                    self._shown = now
                    if not now["open"]:
                        await self._now()  # written down before the reader learns of it
                    yield event_bytes("run", now, self._last_id)
            if not self._shown["open"]:
                return

    async def _look(self) -> Json:
        """The mill's next run is there, so the end of this one may never be told; asked for once a second."""
        if time.monotonic() - self._looked_s < _LOOK_S:
            return self._shown
        self._looked_s = time.monotonic()
        return live_json(await self._now())

    async def _now(self) -> Seen:
        return await self._core.seen(await self._core.do(self._core.runs.get, self._seen.run.id))


async def _of_agent(core: FleetCore, run: RunRow, last_id: str) -> AsyncGenerator[Message]:
    """The messages of the agent's stream."""
    if run.agent_run is None:
        raise AgentAwayError("the run is being prepared")
    link = await core.link_of(run)
    async with contextlib.aclosing(link.feed.messages(last_id)) as messages:
        async for message in messages:
            yield message


def _told(run: RunRow, message: Message) -> list[tuple[str, Json]]:
    """What of an agent's message is about this run; an empty `run` where it tells of another one."""
    if not message:
        return [("ping", {})]
    data = json_object(message.get("data", "").encode(), run.machine)
    if message.get("event") != "status":
        return [("log", data)] if _time_of(data) >= ((run.view or {}).get("created_s") or 0.0) else []
    view = table(data, "run")
    if view.get("id") != run.agent_run:
        return [("run", {})]
    state = run_view(view, run.machine)["state"]
    return [
        ("run", live_json(Seen(replace(run, state=state, view=view, **read_reason(view), open=state not in ENDED))))
    ]


def _time_of(entry: Json) -> float:
    at_s = entry.get("at_s")
    return at_s if isinstance(at_s, int | float) else inf
