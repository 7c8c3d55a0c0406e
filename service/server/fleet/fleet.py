"""The mills of the job server: their state, and the runs of programs on them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Sequence

import sqlalchemy as sa
import structlog

from machines.mill.orders import Stop
from phrases.phrase import Phrase
from service.errors import printable
from service.http.problems import Problem
from service.http.schema import phrase_views
from service.milling.api import PastOrders, RecoverBody, StartBody
from service.server.database.jobs import JobBook
from service.server.database.records import PREPARING, ClientKey
from service.server.database.runs import LIVE_WORDS, RunRow, UnknownRunError
from service.server.fleet.agent_client import OrderContext
from service.server.fleet.agent_feed import parse_event_id
from service.server.fleet.agent_replies import AgentAwayError, as_problem, parse_reply, require_answer
from service.server.fleet.cameras import Cameras
from service.server.fleet.core import FleetCore
from service.server.fleet.event_streams import MachineEvents, RunEvents
from service.server.fleet.handover import Handovers
from service.server.fleet.orders import ASK_S, Controls, Orders, Stops
from service.server.fleet.registry import KnownMachine
from service.server.fleet.representation import (
    Surroundings,
    make_machine_view,
    make_picture_view,
    make_run_view,
    programs_of,
)
from service.server.fleet.timelapse import Timelapses
from service.server.schemas.runs import MachineList, MachineView, RunView, TimelapseView
from service.settings import ServerSettings
from service.store.base import Store

WATCH_S = 10.0
_MEET_S = 1.0  # at the start, for all agents
_MOST_FOLLOWERS = 300
_log = structlog.get_logger("api")


class Fleet:
    """For one event loop. Every refusal is a Problem."""

    def __init__(self, settings: ServerSettings, database: sa.Engine, store: Store, book: JobBook) -> None:
        self._core = FleetCore(settings, database, store, book)
        self._handovers = Handovers(self._core)
        self.orders = Orders(self._core)
        self.stops = Stops(self._core)
        self.controls = Controls(self._core)
        self._cameras = Cameras(self._core.get_http_client)
        self._timelapses = Timelapses(settings.data / "timelapse")
        self._followers = 0

    def end_streams(self) -> None:
        """End the event streams with the server: they would never end by themselves."""
        self._core.ending.set()

    async def await_end(self, seconds: float) -> bool:
        """Wait for that long. Return True as soon as the server ends."""
        return await self._core.await_end(seconds)

    async def meet_agents(self) -> None:
        """Find the addresses of the mills' agents, so that the first stop need not look for them."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_MEET_S):
                await self._core.meet_agents()

    async def watch(self, every_s: float = WATCH_S) -> None:
        """Poll every open run regularly, so that a run that ends while nobody watches is closed too."""
        while not await self._core.await_end(every_s):
            try:
                rows = await self._core.do(self._core.runs.open_ones)
                seen = await asyncio.gather(*map(self._repair_and_look, rows))
                await self._keep_pictures([run for run in seen if run.state in LIVE_WORDS and not run.away])
            except Exception as error:  # the database or a mill is away, or an agent sent invalid data
                _log.warning("runs were not looked at", error=printable(str(error))[:200])

    async def _keep_pictures(self, live: Sequence[RunRow]) -> None:
        """Keep a picture of each of these runs whose mill has a camera, where one is due."""
        if live:
            known, _ = await self._core.list_machines()
            cameras = [(run.id, known[run.machine].camera) for run in live if run.machine in known]
            await asyncio.gather(*(self._keep_picture(run_id, camera) for run_id, camera in cameras if camera))

    async def _keep_picture(self, run_id: str, camera: str) -> None:
        with contextlib.suppress(Problem, OSError):  # the run itself does not suffer from a camera or a disk
            if await self._core.do(self._timelapses.is_due, run_id):
                await self._core.do(self._timelapses.keep, run_id, await self._cameras.take_picture(camera))

    async def aclose(self) -> None:
        self.end_streams()
        await self._handovers.close()
        await self._core.close()

    @property
    def has_live_run(self) -> bool:
        """Return whether one of the mills had a program when it was last polled."""
        return bool(self._core.live_runs)

    # ------------------------------------------------------------------ machines

    async def list_machines(self) -> MachineList:
        known, problems = await self._core.list_machines()
        rows = await asyncio.gather(*(self._describe_machine(machine) for machine in known.values()))
        return MachineList(machines=rows, problems=problems, phrases=phrase_views(problems))

    async def get_machine(self, name: str) -> MachineView:
        return await self._describe_machine(await self._core.find_machine(name))

    async def take_picture(self, name: str) -> bytes:
        """Return a JPEG of the camera beside that mill."""
        machine = await self._core.find_machine(name)
        if not machine.camera:
            raise Problem(
                404,
                Phrase("there is no camera beside {name}; CAUSTICMILL_CAMERAS names the cameras", name=name),
            )
        return await self._cameras.take_picture(machine.camera)

    async def list_pictures(self, run_id: str) -> TimelapseView:
        """Return the pictures of the camera that were kept with the run. Problem 404 if there is no such run."""
        await self._core.get_row(run_id)
        taken = await self._core.do(self._timelapses.list_times, run_id)
        return TimelapseView(pictures=[make_picture_view(run_id, at_s) for at_s in taken])

    async def get_picture(self, run_id: str, at_s: int) -> bytes:
        picture = await self._core.do(self._timelapses.read, run_id, at_s)
        if picture is None:
            raise Problem(404, Phrase("there is no such picture of this run"))
        return picture

    async def _describe_machine(self, machine: KnownMachine) -> MachineView:
        status, away, run = None, None, await self._core.do(self._core.runs.open_on, machine.name)
        try:
            status = await self._core.get_link(machine).get("/v1/status")
            run = None if run is None else await self._repair_and_look(run)
        except (AgentAwayError, Problem) as error:
            away = as_problem(error)
        return make_machine_view(machine, status, away, run if run is not None and run.open else None)

    async def follow_machine(self, name: str, last_id: str) -> AsyncIterator[bytes]:
        """Return what a mill does and what happens at it, as server-sent events without an end."""
        machine = await self._core.find_machine(name)
        return self._follow(MachineEvents(self._core, machine, parse_event_id(last_id)).stream())

    # ------------------------------------------------------------------ runs

    async def park(
        self,
        machine: str,
        job_id: str,
        program: int | str | None,
        by: str,
        key: ClientKey | None,
        context: OrderContext,
        *,
        lift_mm: float | None = None,
    ) -> tuple[RunView, bool]:
        """Hand a program over. Return the run, and whether it is already parked (False: it is still being prepared)."""
        known = await self._core.find_machine(machine)
        with contextlib.suppress(AgentAwayError):
            await self._core.get_link(known).send_once(
                "/v1/lease/check", {}, timeout_s=ASK_S, headers=context.headers()
            )
        run = await self._handovers.begin(known, job_id, program, by, key, lift_mm=lift_mm)
        run = self._core.remember(await self._handovers.finish(run, known))
        return await self._make_view(run), run.state != PREPARING

    async def list_runs(self, *, machine: str | None, job: str | None, limit: int, before: str | None) -> list[RunView]:
        """Return runs, newest first; open ones as their agents have them now."""
        try:
            rows = await self._core.do(self._core.runs.list_rows, machine=machine, job=job, limit=limit, before=before)
        except UnknownRunError as error:
            raise Problem(422, str(error), field="cursor") from None
        seen = await asyncio.gather(*(self._repair_and_look(run) if run.open else _keep_as_it_is(run) for run in rows))
        around = await self._core.do(self._read_surroundings, seen)
        return list(map(make_run_view, seen, around))

    async def get_run(self, run_id: str) -> RunView:
        return await self._make_view(await self._repair_and_look(await self._core.get_row(run_id)))

    async def start(self, run_id: str, said: StartBody, context: OrderContext) -> RunView:
        run = await self._core.get_row(run_id)
        return await self._make_view(await self.controls.start(run_id, said, await self._read_around(run), context))

    async def recover(self, run_id: str, said: RecoverBody, context: OrderContext) -> RunView:
        return await self._make_view(await self.controls.recover(run_id, said, context))

    async def resume(self, run_id: str, context: OrderContext) -> RunView:
        return await self._make_view(await self.controls.resume(run_id, context))

    async def stop_run(self, run_id: str, stop: Stop, context: OrderContext) -> RunView:
        run = await self.stops.stop_run(run_id, stop, context)
        return make_run_view(run, await self.stops.wait_briefly(self._read_around(run), Surroundings()))

    async def list_past_orders(self, machine: str, before: int | None, limit: int) -> PastOrders:
        """Return the orders that this mill was given and by whom, newest first."""
        link = self._core.get_link(await self._core.find_machine(machine))
        from_number = "" if before is None else f"&before={before}"
        reply = await require_answer(link.get(f"/v1/orders?limit={limit}{from_number}"))
        return parse_reply(PastOrders, reply, machine)

    async def follow_run(self, run_id: str, last_id: str) -> AsyncIterator[bytes] | None:
        """Return the run's server-sent events; None if it was over when the reader last heard of it."""
        run = await self._repair_and_look(await self._core.get_row(run_id))
        if last_id and not run.open and not run.away:
            return None
        return self._follow(RunEvents(self._core, run, parse_event_id(last_id)).stream())

    # ------------------------------------------------------------------

    def _follow(self, stream: AsyncGenerator[bytes]) -> AsyncIterator[bytes]:
        if self._followers >= _MOST_FOLLOWERS:
            raise Problem(503, Phrase("too many followers already; ask again later"), headers={"Retry-After": "5"})
        return self._count(stream)

    async def _count(self, stream: AsyncGenerator[bytes]) -> AsyncIterator[bytes]:
        self._followers += 1
        try:
            async with contextlib.aclosing(stream) as pieces:
                async for piece in pieces:
                    yield piece
        finally:
            self._followers -= 1

    async def _repair_and_look(self, run: RunRow) -> RunRow:
        return await self._core.look_at(await self._handovers.repair(run))

    async def _make_view(self, run: RunRow) -> RunView:
        return make_run_view(run, await self._read_around(run))

    async def _read_around(self, run: RunRow) -> Surroundings:
        """Return the surroundings of a run, whose job may have been deleted."""
        return (await self._core.do(self._read_surroundings, [run]))[0]

    def _read_surroundings(self, rows: Sequence[RunRow]) -> list[Surroundings]:
        """Return what each of the runs is part of. A hundred runs need as few queries as one."""
        job_ids = {run.job_id for run in rows}
        found = self._core.jobs.list_with_programs(job_ids)
        finished = self._core.runs.list_finished_by_mill(job_ids)
        programs = {job_id: programs_of(files) for job_id, (_, files) in found.items()}
        return [
            Surroundings(
                job=found[run.job_id][0],
                programs=programs[run.job_id],
                finished=finished.get((run.job_id, run.machine), frozenset()),
            )
            if run.job_id in found
            else Surroundings()
            for run in rows
        ]


async def _keep_as_it_is(run: RunRow) -> RunRow:
    return run
