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

from phrases.phrase import Phrase
from service.http.event_hub import Message
from service.http.problems import Problem
from service.http.streaming import FIRST, PING, compact_json, event_bytes
from service.server.database.runs import ENDED, RunRow, read_reason
from service.server.fleet.agent_client import AgentAwayError, Json, as_problem
from service.server.fleet.agent_feed import AGAIN_S, iterate_until, known_id
from service.server.fleet.agent_replies import json_object, run_view, table
from service.server.fleet.core import FleetCore
from service.server.fleet.representation import make_live_run
from service.server.schemas.runs import LiveRun

_LOOK_S = 1.0


class RunEvents:
    """What one reader of a run is sent."""

    def __init__(self, core: FleetCore, run: RunRow, last_id: str) -> None:
        self._core = core
        self._run = run
        self._last_id = last_id
        self._shown = make_live_run(run)
        self._looked_s = 0.0
        self._failures = 0

    async def stream(self) -> AsyncGenerator[bytes]:
        """Yield bytes of the event stream: `run` events hold how it stands, `log` events what happened."""
        core = self._core
        yield FIRST + _run_event(self._shown)
        while self._shown.open and not core.ending.is_set():
            away: Problem | None = None
            try:
                async for piece in self._follow_live():
                    yield piece
                if not self._shown.open:
                    return
            except (AgentAwayError, Problem) as error:
                away = as_problem(error)
            await core.await_end(AGAIN_S[min(self._failures, len(AGAIN_S) - 1)])
            self._failures += 1
            run = self._run = await self._look_again()
            now = make_live_run(replace(run, away=away) if run.agent_run is None and not run.away else run)
            yield _run_event(now) if now != self._shown else PING
            self._shown = now

    async def _follow_live(self) -> AsyncIterator[bytes]:
        """Yield as long as the agent's stream goes on and the run has not ended."""
        async for message in iterate_until(self._core.ending, _follow_agent(self._core, self._run, self._last_id)):
            if message is None:
                continue
            self._failures, self._last_id = 0, known_id(message.id) or self._last_id
            if not message.data:
                yield PING
                continue
            data = json_object(message.data.encode(), self._run.machine)
            if message.kind != "status":
                if _is_since(data, self._run):
                    yield event_bytes("log", compact_json(data), self._last_id)
            elif (now := _told(self._run, table(data, "run")) or await self._look()) != self._shown:
                self._shown = now
                if not now.open:
                    await self._look_again()  # written down before the reader learns of it
                yield _run_event(now, self._last_id)
            if not self._shown.open:
                return

    async def _look(self) -> LiveRun:
        """Ask once a second where the mill's next run is there: the end of this one may never be told."""
        if time.monotonic() - self._looked_s < _LOOK_S:
            return self._shown
        self._looked_s = time.monotonic()
        return make_live_run(await self._look_again())

    async def _look_again(self) -> RunRow:
        return await self._core.look_at(await self._core.do(self._core.runs.get, self._run.id))


async def _follow_agent(core: FleetCore, run: RunRow, last_id: str) -> AsyncGenerator[Message]:
    """Yield the messages of the agent's stream."""
    if run.agent_run is None:
        raise AgentAwayError(Phrase("the run is being prepared"))
    link = await core.find_link(run)
    async with contextlib.aclosing(link.feed.follow(last_id)) as messages:
        async for message in messages:
            yield message


def _run_event(run: LiveRun, event_id: str = "") -> bytes:
    return event_bytes("run", run.model_dump_json(), event_id)


def _told(run: RunRow, view: Json) -> LiveRun | None:
    """Return how the run stands, by what the agent says of its run; None where that is another one."""
    if view.get("id") != run.agent_run:
        return None
    state = run_view(view, run.machine)["state"]
    told = {"state": state, "view": view, "open": state not in ENDED, "away": None} | read_reason(view)
    return make_live_run(replace(run, **told))


def _is_since(entry: Json, run: RunRow) -> bool:
    """Return whether an entry of the mill's log is younger than the run; one without a time is."""
    at_s = entry.get("at_s")
    return not isinstance(at_s, int | float) or at_s >= ((run.view or {}).get("created_s") or 0.0)
