"""A run's own events, out of the stream of its mill's agent: how it stands, and what has happened at the mill since.

The ids are the agent's, so a reader that comes back with Last-Event-ID, to this server or to the next one, misses
nothing that the agent still has. While the agent is away the reader is told so and the stream goes on; it ends with
the run.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import replace
from math import inf
from typing import Any

from service.fleet.agent_link import AgentAwayError
from service.fleet.agent_words import json_object, run_view, table
from service.fleet.core import FleetCore, Seen
from service.fleet.run_book import ENDED, RunRow
from service.fleet.views import live_json
from service.web.problems import Problem

_EVENT_ID = re.compile(r"[0-9a-f]{1,16}-[0-9]{1,15}")
_AGAIN_S = (0.2, 0.5, 1.0, 2.0)
_PING = b": still here\n\n"

Json = dict[str, Any]


def known_id(text: str) -> str:
    """The id of an event as agents give them; nothing for any other text."""
    return text if _EVENT_ID.fullmatch(text) else ""


async def run_events(core: FleetCore, seen: Seen, last_id: str) -> AsyncIterator[bytes]:
    """Bytes of the event stream: `run` events hold how it stands, `log` events what happened."""
    shown = live_json(seen)
    yield b"retry: 1000\n\n" + _event("run", shown)
    failures = 0
    while seen.run.open and not core.ending.is_set():
        away = ""
        try:
            async for message in _until(core.ending, _of_agent(core, seen.run, last_id)):
                failures, last_id = 0, known_id(message.get("id", "")) or last_id
                for kind, data in _told(seen.run, message):
                    if kind == "run" and data == shown:
                        continue
                    shown = data if kind == "run" else shown
                    if kind == "run" and data["state"] in ENDED:
                        await core.seen(seen.run)  # written down before the reader learns of it
                    yield _event(kind, data, last_id)
                if shown["state"] in ENDED:
                    return
        except (AgentAwayError, Problem) as error:
            away = str(error)
        await core.ended_within(_AGAIN_S[min(failures, len(_AGAIN_S) - 1)])
        failures += 1
        seen = await core.seen(await core.do(core.runs.get, seen.run.id))
        now = live_json(Seen(seen.run, seen.away or (away if seen.run.agent_run is None else "")))
        yield _event("run", now) if now != shown else _PING
        shown = now


async def _until(ending: asyncio.Event, messages: AsyncGenerator[dict[str, str]]) -> AsyncIterator[dict[str, str]]:
    """The messages, as long as the server does not end."""
    over = asyncio.ensure_future(ending.wait())
    try:
        while True:
            step = asyncio.ensure_future(anext(messages, None))
            try:
                await asyncio.wait({step, over}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                if not step.done():
                    step.cancel()
                    await asyncio.gather(step, return_exceptions=True)
            if step.cancelled() or (message := step.result()) is None:
                return
            yield message
    finally:
        over.cancel()
        await messages.aclose()


async def _of_agent(core: FleetCore, run: RunRow, last_id: str) -> AsyncGenerator[dict[str, str]]:
    """The messages of the agent's stream; an empty one for each of its heartbeats."""
    if run.agent_run is None:
        raise AgentAwayError("the run is being prepared")
    link = await core.link_of(run)
    async with link.events(last_id) as lines:
        message: dict[str, str] = {}
        async for line in lines:
            if line.startswith(":"):
                yield {}
            elif line:
                name, _, value = line.partition(": ")
                message[name] = value
            elif message:
                yield message
                message = {}


def _told(run: RunRow, message: dict[str, str]) -> list[tuple[str, Json]]:
    """What of an agent's message is about this run."""
    if not message:
        return [("ping", {})]
    data = json_object(message.get("data", "").encode(), run.machine)
    if message.get("event") != "status":
        return [("log", data)] if _time_of(data) >= ((run.view or {}).get("created_s") or 0.0) else []
    view = table(data, "run")
    if view.get("id") != run.agent_run:
        return []
    state = run_view(view, run.machine)["state"]
    now = replace(run, state=state, view=view, words=view.get("words", ""), open=state not in ENDED)
    return [("run", live_json(Seen(now)))]


def _time_of(entry: Json) -> float:
    at_s = entry.get("at_s")
    return at_s if isinstance(at_s, int | float) else inf


def _event(kind: str, data: Json, event_id: str = "") -> bytes:
    if kind == "ping":
        return _PING
    number = f"id: {event_id}\n" if event_id else ""
    return f"{number}event: {kind}\ndata: {json.dumps(data, separators=(',', ':'))}\n\n".encode()
