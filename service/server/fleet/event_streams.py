"""Event streams of a machine and of a run, made from the stream of the mill's agent.

The ids are the agent's, so a reader that comes back with Last-Event-ID, to this server or to the next one, misses
nothing that the agent still has. While the agent is away the stream says so and goes on: a machine's stream has no end,
a run's ends with the run. A new follower of a machine gets the events that its agent remembers.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import replace

from phrases.phrase import Phrase
from service.http.event_hub import FIRST, PING, Message, compact_json, event_bytes
from service.http.problems import Problem, ServerCode
from service.server.database.runs import ENDED, RunRow, read_reason
from service.server.fleet.agent_client import AgentLink, Json
from service.server.fleet.agent_feed import AGAIN_S, iterate_until, parse_event_id
from service.server.fleet.agent_replies import AgentAwayError, as_problem, json_object, run_view, table
from service.server.fleet.core import FleetCore
from service.server.fleet.registry import KnownMachine
from service.server.fleet.representation import make_live_run, make_machine_view
from service.server.schemas.runs import LiveRun, MachineView

_TICK_S = 0.5  # how often the open run is looked up
_BEAT_S = 15.0
_LOOK_S = 1.0  # how often a run's row is read from the database


class MachineEvents:
    """The event stream of a machine for one reader."""

    def __init__(self, core: FleetCore, machine: KnownMachine, last_id: str) -> None:
        self._core = core
        self._machine = machine
        self._last_id = last_id
        self._status: Json | None = None
        self._shown: MachineView | None = None
        self._last_sent: tuple[float, float] = (0.0, 0.0)  # time and number of the last entry of the log
        self._remembered = bool(last_id)
        self._sent_s = self._looked_s = 0.0
        self._run: RunRow | None = None
        self._failures = 0

    async def stream(self) -> AsyncGenerator[bytes]:
        """Yield bytes of the event stream: `status` events with the state of the machine, `log` events with what
        happened.
        """
        core = self._core
        yield FIRST
        while not core.ending.is_set():
            try:
                async for piece in self._follow_live():
                    yield piece
                away = Problem(503, "the event stream of its agent has ended", code=ServerCode.AGENT_SILENT)
            except (AgentAwayError, Problem) as error:
                away = as_problem(error)
            self._status = None
            yield await self._make_state(away, fresh=True) or PING
            if await core.await_end(AGAIN_S[min(self._failures, len(AGAIN_S) - 1)]):
                return
            self._failures += 1
            with contextlib.suppress(Problem):  # its profile is gone: it keeps its last description
                self._machine = await core.find_machine(self._machine.name)

    async def _follow_live(self) -> AsyncGenerator[bytes]:
        """Yield as long as the agent's stream goes on."""
        link = self._core.get_link(self._machine)
        self._status = await link.get("/v1/status")
        yield await self._make_state(fresh=True)
        messages = iterate_until(self._core.ending, link.feed.follow(self._last_id), tick_s=_TICK_S)
        async with contextlib.aclosing(messages):
            async for message in messages:
                self._failures = 0
                if message is not None:
                    for entry in await self._read_history(link):
                        yield entry
                    self._last_id = parse_event_id(message.id) or self._last_id
                if piece := await self._read_piece(message):
                    yield piece

    async def _read_piece(self, message: Message | None) -> bytes:
        if message is None or not message.data:
            return await self._make_state()
        data = json_object(message.data.encode(), self._machine.name)
        if message.kind == "status":
            self._status = data
            return await self._make_state()
        return self._make_entry(data, self._last_id)

    # ------------------------------------------------------------------ what happened

    async def _read_history(self, link: AgentLink) -> list[bytes]:
        """Return the events that the agent remembers, for a new reader. Call it once the agent's stream is open: then
        no event is lost in between.
        """
        if self._remembered:
            return []
        entries = (await link.get("/v1/status")).get("events", [])
        self._remembered = True
        if not isinstance(entries, list):
            return []
        return [piece for entry in entries if isinstance(entry, dict) and (piece := self._make_entry(entry))]

    def _make_entry(self, entry: Json, event_id: str = "") -> bytes:
        """Return the event of an entry; nothing for one that was already sent."""
        place = (_number(entry, "at_s"), _number(entry, "number"))
        if place != (0.0, 0.0) and place <= self._last_sent:
            return b""
        self._last_sent = max(place, self._last_sent)
        return event_bytes("log", compact_json(entry), event_id)

    # ------------------------------------------------------------------ how it stands

    async def _make_state(self, away: Problem | None = None, *, fresh: bool = False) -> bytes:
        """Return a `status` event if the state has changed, a comment now and then, otherwise nothing."""
        now_s = time.monotonic()
        view = table(self._status or {}, "run")
        if fresh or now_s > self._looked_s + _TICK_S or self._run_is_news(view):
            self._looked_s = now_s
            self._run = await self._find_open_run(view)
        run = self._run
        if run is not None and _is_about(view, run):
            run = replace(run, view=run_view(view, self._machine.name))
        shown = make_machine_view(self._machine, self._status, away, run)
        if shown != self._shown:
            self._shown, self._sent_s = shown, now_s
            return event_bytes("status", shown.model_dump_json(), self._last_id)
        if now_s > self._sent_s + _BEAT_S:
            self._sent_s = now_s
            return PING
        return b""

    def _run_is_news(self, view: Json) -> bool:
        known = None if self._run is None else (self._run.agent_run, self._run.state)
        return bool(view) and known != (view.get("id"), view.get("state"))

    async def _find_open_run(self, view: Json) -> RunRow | None:
        """Return the run that has the mill. If the agent reports something new about it, store that."""
        runs = self._core.runs
        run = await self._core.do(runs.open_on, self._machine.name)
        if run is not None and _is_about(view, run):
            run = await self._core.do(runs.record_report, run, run_view(view, self._machine.name))
        return run if run is not None and run.open else None


def _is_about(view: Json, run: RunRow) -> bool:
    """Return whether the agent's report is about this run."""
    return run.agent_run is not None and view.get("id") == run.agent_run


def _number(entry: Json, name: str) -> float:
    value = entry.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


class RunEvents:
    """The event stream of a run for one reader."""

    def __init__(self, core: FleetCore, run: RunRow, last_id: str) -> None:
        self._core = core
        self._run = run
        self._last_id = last_id
        self._shown = make_live_run(run)
        self._looked_s = 0.0
        self._failures = 0

    async def stream(self) -> AsyncGenerator[bytes]:
        """Yield bytes of the event stream: `run` events with the state of the run, `log` events with what happened."""
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
            self._failures, self._last_id = 0, parse_event_id(message.id) or self._last_id
            if not message.data:
                yield PING
                continue
            data = json_object(message.data.encode(), self._run.machine)
            if message.kind != "status":
                if _is_since(data, self._run):
                    yield event_bytes("log", compact_json(data), self._last_id)
            elif (now := _read_run_state(self._run, table(data, "run")) or await self._look()) != self._shown:
                self._shown = now
                if not now.open:
                    await self._look_again()  # stored before it is sent to the reader
                yield _run_event(now, self._last_id)
            if not self._shown.open:
                return

    async def _look(self) -> LiveRun:
        """Ask once a second when the mill has another run: the agent may never report the end of this one."""
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


def _read_run_state(run: RunRow, view: Json) -> LiveRun | None:
    """Return the run's state from the agent's report; None if the report is about another run."""
    if view.get("id") != run.agent_run:
        return None
    state = run_view(view, run.machine)["state"]
    changes = {"state": state, "view": view, "open": state not in ENDED, "away": None} | read_reason(view)
    return make_live_run(replace(run, **changes))


def _is_since(entry: Json, run: RunRow) -> bool:
    """Return whether an entry of the mill's log is newer than the run; one without a time counts as newer."""
    at_s = entry.get("at_s")
    return not isinstance(at_s, int | float) or at_s >= ((run.view or {}).get("created_s") or 0.0)
